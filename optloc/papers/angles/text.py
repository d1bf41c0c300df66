"""What the page of the paper says around its tables."""

from __future__ import annotations

TITLE = "Tracking by azimuth and elevation with the current statistical model"

OPENING = """\
Two stations that stay measure azimuth and elevation of a moving target once a second. The paper (Liu Zhe, Wei Junhu,
Huang Wenzhun, Huang Shiqi: *A new method of target location and tracking by log-likelihood estimation*, in Chinese)
updates the state by normal equations of angles linearised at the prediction, and predicts it by the current statistical
model of Zhou and Kumar. Its three simulations are made again here.

- **single step** is the update of the paper. It is the extended Kalman filter, exactly: pseudo-measurements
  z − h(ŝ) + Hŝ in normal equations give the textbook gain.
- **converged** repeats the linearisation until the state no longer moves. That is the point that the paper's own
  equation 16 asks for, and the iterated extended Kalman filter.
- A **fit** is `optloc.track.batch.fitted`, or `optloc.track.begun` for a single run: maximum likelihood of a polynomial
  course through several seconds, without a guess. `optloc.solve` starts it by pseudo-linear least squares of the whole
  stretch with instrumental variables.

## How the paper was read

- **Missing:** the time constant is 10 s ("manoeuvre constant 10"), scans are at 1, 2, ... 50 s, the target of the first
  simulation moves along x. The largest acceleration a_max of the model and the start are not given: the tables show
  several of the first, and say what was taken for the second. Agreement with a printed number says that it can be
  reached, not that these were the paper's values.
- **Simulation 2** is x = 2t, y = 10 sin(5πt/180).
- **Simulation 3** prints the same place for both stations; they stand at (∓40, 0, 0) km here. The speed of the straight
  parts has no unit, 500 s of a circle at 0.157 rad/s are 12.494 turns, and the speed jumps at both transitions. The
  *repaired* one flies at 471 m/s throughout: 100 s straight, one full turn in 40 s, 100 s straight.
- **Bounds.** The posterior bound has the process noise of the model, with its variance at acceleration zero, and
  averages over all tracks that this noise makes. A track that is smoother can beat it, and these are."""

CLOSING = """\
## What is wrong in the paper

1. The update is not a closed form of the stated problem: it is one Gauss-Newton step towards it. "Avoiding iterations"
   is what loses tracks where the stations and the start lie on one line, as they do in simulation 1 (table *starts*).
   Some more steps on the same cost keep them all; a fit of three seconds needs no start at all.
2. It is not the pseudo-linear estimator either, whose rows sin A (x − x_i) − cos A (y − y_i) = 0 carry noise in their
   coefficients: the tables *whole-track* and *rays* show what that costs, and that instrumental variables mend it.
3. f33 of the transition is printed as 1 − exp(−αT), three times. It has to be exp(−αT): at αT = 0.1 the printed one
   forgets nine tenths of the acceleration in a second. The printed acceleration error, 0.176 of 0.2 m/s², is near to
   what this slip gives, whatever a_max is; with the right one it depends on a_max and is smaller.
4. U is printed as one vector of nine that multiplies three accelerations; it is block diagonal. Q₀ and the rule of the
   variance are not printed.
5. Angles are those of station minus target with the principal arctangent. Sine and cosine then flip where the target
   is to the right of a station, and simulation 1 runs away; with the two-argument one the filter is the one here. The
   signs of equation 19 contradict those of equation 20 and of H.
6. L(s) lacks a factor of one half, and D is printed with the target minus its own prediction.
7. With the acceleration for its mean, the model predicts the state by plain constant acceleration; time constant and
   a_max act through the covariance alone. That decays as Singer's does: in a long manoeuvre it is too small.
8. The variance of the model vanishes where the acceleration comes near a_max, just when the target manoeuvres. With
   a_max = 100 the filter fails in the circle of 74 m/s² in every reading; with four times the peak it is near the
   bound. Beyond a_max the published variance grows without end; here the distance is held at 5 % of a_max (table
   *clamp*).
9. In simulation 2 the printed errors are those of the first seconds: without them the filter is twenty times better.
   The acceleration there never exceeds 0.0762 m/s²: an error of 0.47 is not "within 25 %".
10. Simulations 1 and 2 need different starts to give the printed numbers; the text says that they have the same.
11. That the error of simulation 3 comes near the bound is true of the model's own bound. A linear filter on the fixes
    of every second does as well: it is the model of motion that limits, not the linearisation."""

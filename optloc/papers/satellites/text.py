"""What the page says around its tables."""

from __future__ import annotations

TITLE = "Three satellites and a known height: four Kalman filters"

OPENING = """\
Three satellites 800 km high and 90 km apart receive the pulses of a ship near 25.8° N, 127.4° E. Two differences of
their arrival times (50 ns each) and an assumed height (500 m) give one position a second. The paper compares four
extended Kalman filters on this task and finds its own, with a covariance that is linearised anew after the update
(MVEKF), the fastest and best. The comparison is made again here:

- **EKF** linearises once, at the prediction. **IEKF** repeats that at the new state until nothing moves, damped.
- **MGEKF** replaces the derivative in the covariance by a function g with h(x) − h(y) = g (x − y) exactly; g is the
  mean of the derivative over the way from the prediction to the update, which exists for every kind of measurement.
- **MVEKF** moves the state like the EKF, and linearises again for the covariance only.
- **From two fixes**: every fix is solved without a guess. The range differences and the ellipsoid at the given
  height give a quartic, of whose roots one is in sight of all satellites; one more step takes in the noise. Two
  fixes give place and velocity, with the covariance between both.

The *posterior bound* is that of Cramér and Rao for the model of motion, in covariance form. Where it is met, a root
mean square of 200 trials still scatters about it by five per cent, alike for all filters: they see the same data.

## How the paper was read

- Time step, length and process noise are not printed: 1 s, 200 steps and 0.01 m/s² are used. Heights are white with
  500 m, and the satellites stay where they are in the Earth's frame, both as printed.
- z = r1 − r2 and r1 − r3: positive when the first satellite is the farther one.
- *Relative error* is the mean error over 100 km.
- *Start error* is that of each coordinate, with a covariance that says so, and 50 m/s for the velocity."""

CLOSING = """\
## What follows

1. Started by fixes, as the paper says it does, the four filters are one: what they linearise is bent by δ²/2r, 0.15
   m for an error of 500 m, against noise of 15 m. They reach the bound.
2. They come apart when the start is wrong by tens of kilometres. One epoch then determines the place, but a single
   linearisation misses by δ²/2r, some 10 km for 100 km, while the covariance says 0.6 km. Only iteration repairs
   that; the MGEKF survives because its covariance stays large. The order is IEKF, MGEKF, and far behind MVEKF and
   EKF.
3. The claim that MVEKF is best holds against the EKF, moderately, for start errors of 30 to 200 km. It holds nowhere
   against the IEKF.
4. A fix needs no start, so the question does not arise: from two fixes even the EKF is at the bound.
5. The height is the weak point. A wrong height is a constant and never averages out; a filter that takes it for
   white noise is wrong by seven times what it claims. As a constant among the states it stays in the covariance. The
   height of the sea is known far better than 500 m, and may be held exactly.

## What is wrong in the paper

1. The height of equation 2, H = √((1 − f)² (x² + y²) + z²) − R, vanishes on the ellipsoid only if R is the polar
   radius. With the equatorial one it is 21 385 m off, and the fix 22 km. Here the height is the exact geodetic one.
2. The velocity (20, 20, 0) m/s in the Earth's frame climbs by 3.4 m/s: the ship is 339 m high after 100 s. The table
   of heights, but for its last row, has a ship that stays on the surface; elsewhere it climbs as printed, and its
   true height is what is measured.
3. White heights with 500 m are no model of an assumed height.
4. Satellites in low orbits fly 7.4 km/s; with satellites that stay the bound is within about 10 % of the true one up
   to 50 s, and at 200 s too small by 20 to 75 %, by heading.
5. The covariance of the two-point start lacks the term between place and velocity, and the second fix is used twice.
   Both are harmless.
6. The IEKF is described as using "the filtered value and covariance repeatedly". Taken literally that uses one
   measurement several times over; the iteration must begin from the same prediction each time.
7. Step 6 of the MVEKF writes K for two different gains; the first moves the state only.
8. If 50 ns is the noise of a difference of three arrivals, the two differences are correlated by one half."""

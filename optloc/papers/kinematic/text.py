"""What the page says around its tables: how the paper was read, and what is wrong in it."""

from __future__ import annotations

TITLE = "TDOA location of targets that stand, fly on or accelerate"

OPENING = """\
Four stations measure three range differences of each of three distant targets in the plane. The paper (W. Li, J. Liu,
H. Li, *A method of TDOA location in LOS environment based on target movement pattern*, Missiles and Space Vehicles
2024/5, doi:10.7654/j.issn.2097-1974.20240501) fixes each target once and goes on with a Kalman filter whose model is
static, of constant velocity (CV) or of constant acceleration (CA). Its section 3 is made again here with
`optloc.track`, on one measurement model and with the equations put right.

- The **fix** of the first epoch is `optloc.solve`, without a guess. It is the best linear unbiased estimate of the
  paper when its steps have converged.
- The **static** filter is the recursion of the fix; **CV** and **CA** are `optloc.track.followed` with
  `polynomial(1)` and `polynomial(2)` and the update `ekf`.
- The paper proposes to run several models side by side and to judge them afterwards: `parallel` of
  `optloc.track.parallel` does, by likelihood. `imm` of `optloc.track.imm` lets the models interact.
- Rows that do not say whose they are go through `associated` of `optloc.track.multiple`, with one of the rules of
  `optloc.track.associate`: the nearest row of each channel, whole sets of rows for each target, or for all together.

## How the paper was read

Given are the targets, (300, 400), (350, 450) and (250, 350) km, their speeds of 1, −1 and 1 km/s along y, their
accelerations of −0.1, 0.1 and 0.1 km/s², 20 steps and 100 runs. Stations, noise, interval, priors and the definition of
the mean error are not given. Chosen were:

| what | value | why |
| --- | --- | --- |
| stations | the reference at the origin, three others 100 km out at 90, 210 and 330 degrees | the usual Y |
| noise | 80 ns for each difference, independent | a single fix is then 0.96 km off; printed are 0.98 km |
| interval | 2.25 s | the CV filter on accelerated targets is then 10.3 km off; printed are 10.6 km |
| direction of acceleration | along y, as the speed | the literal reading |
| priors | 2 km/s and 1 km/s² about zero | loose |
| mean error | distance, averaged over runs, targets and steps 1 to 20 | |
| "static" line | fixes of single epochs | with 20 updates it would be far better than the CV line, not worse |

Noise and interval are fitted to two lines of table 1, so those prove nothing. The other two do: see *ratios*."""

CLOSING = """\
## What is wrong in the paper

1. Equations 2, 8 and 15 take r0 − ri where 1, 3, 11 and 21 take ri − r0: the steps go away from the target, and none
   of them arrives (table *equations*).
2. Equation 5 calls the fix with equal weights the best linear unbiased one. It is, if the differences are independent.
   They share the reference station; with R = σ²/2 (I + 11') equal weights cost 13 %.
3. Equations 7 and 28 have four rows; there are three differences.
4. The gate of equation 12 compares with a threshold μ that is never defined, and uses a distance that is not either.
   Read as the innovation in its own standard deviations, five of them, it can be built.
5. A missed difference is set to its prediction, and the covariance is updated as if it had been measured. The filter
   then trusts itself too much. The row has to be left out.
6. Equation 18 has a driving noise; equation 26 has lost its covariance Q. The gain goes to zero, and a wrong model is
   never forgiven.
7. Equation 22 subtracts a station from the whole state instead of the position.
8. Equation 29 multiplies the columns of velocity and acceleration by the interval and half its square. They are zero:
   the transition has been applied already. Table 1 cannot have come from the printed form.
9. The CV filter is described as the CA filter with a = 0. Acceleration has to leave P and H as well.
10. The printed times of 0.40 to 0.47 ms hardly depend on the size of the state, so they are mostly overhead of calls.

## What helps

- **Wrong model.** Process noise for the acceleration that may come costs a quarter of the accuracy where the model was
  right, and a factor of ten is won where it was not. Models side by side cost nothing and are right from the fifth
  step on, but only as long as the target keeps its motion; models that interact follow when it does not.
- **Rows without names.** The targets lie in nearly one direction and their differences are close together. While the
  velocity is unknown the gate of a single channel is as wide as the gaps between them, and the nearest row is often
  the neighbour's. Whole sets of rows, scored with their joint covariance, lose few tracks; sets of all targets
  together, no row used twice, fewer still."""

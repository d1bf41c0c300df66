"""What the page says around its tables."""

from __future__ import annotations

TITLE = "One receiver and one illuminator: slow targets by excess path and direction"

OPENING = """\
A receiver at the origin hears the echo of an illuminator of opportunity 150 km away on the x axis. It measures the
excess path l = r + |r u − A| − d of the echo (20 ns) and its azimuth and elevation (1° each), once a second, of a
target 81.2 km away. The paper estimates range and angles by a recursion that is cheaper than least squares. It is
made again here, corrected, beside what optloc does with the same data; nothing is started by a guess.

- **simplified** is the recursion of the paper with its signs and indices corrected: running means of both angles,
  and a scalar gain for the range. It begins from the fix of the first epoch. *restart* begins it anew every so many
  epochs, from one fix or from the mean of ten epochs; a *gain floor* never lets a gain fall below one in twenty.
- **maximum likelihood** of a target that stays is the fix of the mean measurement: three unknowns, three means.
- **line fit** is a straight line through each of the three measurements, solved at its end (`optloc.track.lines`).
- **pseudo-linear course** is linear in place and velocity, and exact without noise; **batch maximum likelihood** is
  `optloc.solve` on the whole record, which it starts.
- **Cartesian EKF and IEKF** have a state of six, velocity 0 ± 50 m/s, and begin from the first epoch.

## How the paper was read

The paper does not give the length of the record (200 epochs here: the lag then exceeds the noise, as the text on its
figures says) or the period of the restarts (10 to 100 here). The velocity (4, 10, 6) m/s is taken with the signs as
printed: the range grows by 11 m/s."""

CLOSING = """\
## What follows

1. A target that stays needs no recursion: the fix of the mean is cheaper, and has √2 less error in range. The
   recursion averages the ranges that the running means of the angles imply, whose errors are alike.
2. Of the variance of the range 99.97 % is the azimuth's: 74.3 km/rad times 1° over 1.388 are 934 m; the path adds 4
   m and the elevation 14 m. Better angles are worth the effort, a better delay is not.
3. A slow target is followed late, by v n / 2 after n epochs. A restart throws the average away; to begin anew from
   the mean of ten epochs, or never to let the gain fall below a floor, is better than any period of plain restarts.
4. In the measurements themselves the slow target moves on straight lines and nothing has to be linearised: the line
   fit is ten times better than the recursion after 200 epochs, and near the bound.
5. The Cartesian filters miss the bound by far: 6 m along against 1.4 km across are a curved ridge. One linearisation
   a scan does not follow it, and iteration helps little, for no Gaussian state has that shape.

## What is wrong in the paper

1. Section 2.2 puts the receiver at (d, 0, 0). It is the illuminator that is there.
2. Equation 9 has the angles themselves as factors of the partial derivatives: 107.4 for 74.26 km/rad in azimuth and
   0.142 for 1.152 km/rad in elevation.
3. Equation 11 sums the residuals, not their squares, and has no minimum; its weights are the variances, not their
   inverses. For a target that stays all weights cancel anyhow.
4. Equation 10 leaves open whether one measurement or all of a record are meant.
5. Steps 1 and 2 move the angles away from the measurement: the sign is wrong, and the error grows with every epoch
   (table *printed*).
6. Step 4 uses a range before it exists and the measurement before the present one, and its residual mixes
   quantities. It is y = l − l(r, az, el) − l_az Δaz − l_el Δel at the previous state.
7. Step 6 adds K (y − x Δr); it has to be K y. Step 7 writes k for K.
8. P = 1 at the start weighs the second epoch more than the first: its gain is 0.474, where equal weights need 0.360.
   It does no harm and is kept.
9. As printed the recursion diverges; the figures come from another program."""

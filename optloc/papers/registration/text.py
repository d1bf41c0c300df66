"""What the page says around its tables: how the paper was read, and what is wrong in it."""

from __future__ import annotations

TITLE = "Registration of moving stations by TDOA and GROA"

OPENING = """\
Five moving stations measure the range differences of one emitter once a second; every channel has an unknown constant
bias, and the reported station positions are wrong by a metre or five, anew at each epoch. The paper (*Error
registration of multiple moving observers by TDOA and GROA*, Journal of Electronics & Information Technology 39, 2017)
estimates target and biases by least squares. Its section 4 is made again here in two ways, on the same data:

- **recursion** is the algorithm as printed: from a Gaussian start near the truth, two undamped steps over all past data
  at each epoch from the fortieth on. The start is one sigma0 wide where nothing else is said.
- **optloc** is `optloc.solve` on the epochs so far. It takes no start and knows nothing of the truth.

*Lost* is an estimate that is not finite, or further from the truth than ten bounds; errors are those of the trials that
are not lost. *Ambiguous* is a fix of optloc that says so and lists the other place; *lost and ok* is one that is lost
and does not say so. The *bound* is that of Cramér and Rao with the biases unknown.

## How the paper was read

- **Noise.** The covariance of the four differences of an epoch is R = σ² (I + 11'), σ = 3 m, which is 10 ns at
  c = 3·10⁸ m/s, though the text says 20 ns. Only this reading gives the printed sigma0 = (1855, 2758, 160) m: the table
  *readings* compares the others. Gain ratios are read the same way, with 0.03.
- **Station errors** of 1 m or 5 m in each coordinate, drawn anew at each epoch, are part of the weight: R grows by
  G Qs G'. For range differences that is another σs² (I + 11') wherever the target is.
- **Epochs.** The result at 600 s uses 600 epochs, the first at t = 0. Position errors of the moving target are those of
  its place at t = 0: only so does the printed 633 m fit.
- **Accuracy** of a bias is not defined. It is read as 100 (1 − |mean error over all trials| / |bias|), zero where the
  error is the larger. One run is far less accurate than this mean, so two columns give one run: root mean square error
  in the place of the mean, and the bound."""

CLOSING = """\
## What is wrong in the paper

1. Equation 23, the bound for unknown biases, is printed as X − Y Q Y'. With the stacked Q that allows a new bias at
   every epoch, and nothing is left of the information. It has to be X − Y (Σ R⁻¹)⁻¹ Y'. Equation 24 has lost a sign.
2. Equation 15 stacks the target once for each epoch; it is one unknown. The corner of size 3 + 3M is that of one epoch.
3. sigma0 is said to follow from equation 23. It is equation 25, with known biases, for the single epoch t = 0.
4. Stations 4 and 5 of table 1 meet at t = 50 s: their distance is exactly zero.
5. All five stations lie in one plane at every epoch, so five are not enough for the closed form that the paper counts
   on: one epoch says nothing about the side of the plane on which the target is.
6. For that reason the fixed target has a second minimum, the image in the plane (table *minima*). It costs little
   in short records, and it is what catches the recursion when the noise is large: not the worse initial guess that
   the paper blames, for as many trials are lost when the recursion is started at the truth itself (table 4).
7. The image of a uniformly moving target moves uniformly as well, and explains all data exactly. The paper does not say
   so; its recursion stays on the side on which it was started. optloc lists both places and calls the fix ambiguous; a
   height or a speed has to decide. The scores are those of the listed place nearer to the truth.
8. The recursion cannot start the moving target at 40 s: the bound of the position is 618 km by then, and every trial
   runs away. It is started at 200 s here.
9. Table 4 is said to hold at 700 s. Its errors are those of 600 s, where the bound is 40.3 m; at 700 s it is 29.8 m.
   The labels 20 to 50 ns stand for 10 to 40 ns.
10. The bounds of tables 3 and 4, 36.7 to 146.7 m, are in the ratio 1 : 2 : 3 : 4: without station errors. They are not
    reproduced at 600 or at 700 s, with or without them.
11. The text on table 5 refers to table 3. The zeros of table 5 are errors larger than the bias.
12. The gain ratios, with 0.03, change the bound by less than one part in 100 000: the better error of figure 3 (71 and
    36 m against 75 and 39 m) is the scatter of 200 trials. They help from about 3·10⁻⁴ on (table *gains*). The
    recursion is not run with them.

The error of 200 trials scatters by about five per cent. Divergence of 2.5 % is 5 trials of 200: the 95 % interval is
0.8 to 5.7 %."""

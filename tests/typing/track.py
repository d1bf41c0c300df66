"""A track without a first guess, its state in another order."""

import numpy as np

import optloc

times = np.arange(20.0)
stations = 1e3 * np.array([[0.0, 0], [10, 0], [0, 10], [9, 9]])
rows = optloc.measured("range", a=np.tile(np.arange(4), 20), epoch=np.repeat(np.arange(20), 4), sigma=5.0)
run = optloc.assemble(stations, rows, times=times, motions=(optloc.Motion(1),))
drawn = optloc.simulate(run, np.array([2e3, 3e3, 20.0, -10.0]), seed=1)
track = optloc.track(drawn, "cv")
mean, cov = track.states("x vx y vy")
print(mean.shape, cov.shape, track.last.time)

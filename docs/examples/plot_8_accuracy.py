"""
Errors against the bound
========================

Two hundred simulations at each noise. Differences against one receiver share the noise of this receiver. A fix with
the correct covariance reaches the Cramér-Rao bound. A fix that assumes independent rows does not.
"""

import numpy as np

import optloc
from optloc.show.pictures import plot_accuracy

stations = np.array([[0, 0], [10, 1], [2, 9], [11, 8], [5, -4], [-3, 5]]) * 1e3
pairs, truth, noise = {"a": [1, 2, 3, 4, 5], "b": 0}, np.array([6e3, 14e3]), np.array([1.0, 3.0, 10.0, 30.0])
errors, bound = {"correlated, as they are": [], "taken for independent": []}, []
for sigma in noise:
    template = optloc.assemble(stations, optloc.measured("tdoa", **pairs, arrival_sigma=sigma))
    problem = optloc.simulate(template, truth, seed=1, trials=200)
    naive = optloc.assemble(stations, optloc.measured("tdoa", problem.z, **pairs, sigma=np.sqrt(2.0) * sigma))
    for rmse, each in zip(errors.values(), (problem, naive), strict=True):
        rmse.append(np.sqrt(((optloc.solve(each).position - truth) ** 2).sum(-1).mean()))
    bound.append(np.sqrt(np.trace(optloc.crlb(template, truth))))
figure = plot_accuracy(noise, errors, bound, "Six receivers, five differences")

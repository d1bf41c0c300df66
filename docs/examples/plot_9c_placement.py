"""
Station placement
=================

Eight of forty masts are chosen. Fixes at twelve places are as accurate as possible, even if one mast fails. The
bars below the maps show the accuracy after the loss of each mast, without and with the best replacement.
"""

import numpy as np

import optloc
from optloc.sites.placement import picture

rng = np.random.default_rng(3)
masts = rng.uniform([-3000, -3000, 0], [3000, 3000, 300], (40, 3))
places = rng.uniform([-4000, -4000, 0], [4000, 4000, 500], (12, 3))
problem = optloc.assemble(masts, optloc.measured("toa", a=np.arange(40), sigma=3.0))
selection = optloc.sites.placement.SiteSelection(problem, places, choose=8, fail_one=True)
figure = picture(selection, optloc.place(selection))

"""Registration in full: every trial on the optimum next to the truth, errors as large as the bound and no larger."""


from runs import run

FULL, JOINT, GAUSSIAN = 2000, 1000, 500
PRIOR = 200.0

LONG = {f"{k} epochs, {sigma:g} m": run(k, sigma=sigma) for k in (600, 700) for sigma in (3.0, 6.0, 9.0, 12.0)}
LONG = {name: problem for name, problem in LONG.items() if "700" not in name or name[-4:-1] in (" 3 ", " 12")}

"""Studies of methods, reproduced papers and measured data sets."""

"""What the residuals of many fixes say of the measurements: noise levels, station biases, gross errors."""

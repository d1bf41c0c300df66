"""One problem at one point: residual, Jacobian, normal equations, constraints."""

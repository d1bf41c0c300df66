"""Location of moving targets by TDOA with static, uniform and accelerated models: section 3 of the paper."""

"""Learning with the environments: policies exported, evaluated beside baselines."""

"""What a study runs: points of experiments, trainings, gain designs, exact optima."""

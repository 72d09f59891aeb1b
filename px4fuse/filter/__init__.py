"""One axis: the filter's model, signals, replay, likelihood, consistency, noises and clock."""

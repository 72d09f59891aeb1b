"""KF: model, input, run, likelihood and consistency; estimates of noises and time offset."""

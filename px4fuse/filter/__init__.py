"""KF: model, signals, replay, likelihood and consistency; estimates of noises and time offset."""

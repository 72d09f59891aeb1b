"""The numbers that detectors compare with, each with its unit and source."""

from __future__ import annotations

from px4fuse.findings.model import Threshold

MIN_IMU_RATE = Threshold(
    50.0, "Hz", "5 IMU samples per DT of 0.1 s and 10 with margin for aliasing"
)
MIN_ATTITUDE_RATE = Threshold(10.0, "Hz", "PX4's default is 20 Hz; slerp bridges 0.1 s of a tilt")
RATE_MARGIN = 0.98  # a stream set to a rate runs a little below it
MIN_INNOVATION_SHARE = Threshold(
    0.75, "of the source's samples", "a quarter lost biases nothing yet"
)
LOGGER_INTERVAL_TOLERANCE = Threshold(
    0.25, "of the interval", "jitter of PX4's logger seen in flights"
)
EV_START_INTERVAL = Threshold(0.2, "s", "EV_MAX_INTERVAL, PX4 v1.14 and later, ev_control.cpp")
EV_STOP_INTERVAL = Threshold(0.4, "s", "two times EV_MAX_INTERVAL, ev_pos_control.cpp")
FUSING_SHARE_ERROR = Threshold(
    0.5, "of the segment", "below, EKF2's track is mostly not the source's"
)
FUSING_SHARE_WARNING = Threshold(0.98, "of the segment", "one second in a flight of a minute")
REJECTED_SHARE_WARNING = Threshold(0.01, "of the innovations", "5 σ rejects 6e-7 when consistent")
REJECTED_SHARE_ERROR = Threshold(0.20, "of the innovations", "one in five: R or the clock is wrong")
GAP = Threshold(1.0, "s", "ten prediction steps without a measurement")
GAP_INTERVALS = Threshold(5.0, "median intervals", "jitter and single losses pass")
ACCELEROMETER_BIAS = Threshold(0.2, "m/s²", "half of EKF2's own limit, EKF2_ABL_LIM")
VARIANCE_FACTOR = Threshold(
    1.5, "times", "22 % in standard deviation; chance moves it less at n > 100"
)
VARIANCE_FACTOR_ERROR = Threshold(4.0, "times", "a factor of two in standard deviation")
IMU_GAP_TOTAL = Threshold(0.2, "s", "two prediction steps")
EKF2_NOISE_FLOOR = Threshold(0.01, "m", "EKF2 never trusts external vision better, EKF2.cpp")
NOISE_FITS = Threshold(1.25, "times", "the median's own scatter below n = 100 (1.17/√n, two σ)")
NOISE_ABSURD = Threshold(2.0, "times", "beyond, a small SIGMA_A explains it rather than the source")
LAG1_SLOW = Threshold(0.3, "correlation", "white innovations stay below 2/√n, 0.2 at n = 100")
SMALLEST_NOISE = Threshold(0.001, "m", "below what any positioning system resolves")
RESPONSE_TIME = Threshold(2.5, "s", "five times the lesson's; a vehicle turns around in less")
OUTLIER_SHARE = Threshold(0.005, "outside 5√S", "6e-7 is expected")
MOTION_RANGE = Threshold(0.5, "m", "5 to 95 % range; a hovering drone with 0.1 m UWB stays below")
CLOCK_OFFSET = Threshold(0.03, "s", "at 1 m/s a third of a good UWB's noise")
CLOCK_OFFSET_ERROR = Threshold(0.10, "s", "at 1 m/s a good UWB's noise")
CLOCK_SIGMAS = Threshold(3.0, "standard deviations", "0.3 % of clean flights lie beyond")
HEADING_SIGMAS = Threshold(3.0, "standard deviations", "0.3 % of clean flights lie beyond")
HEADING_ERROR = Threshold(5.0, "°", "EKF2's magnetic heading was off by 3 to 4° in flights seen")
HEADING_ERROR_LARGE = Threshold(15.0, "°", "a quarter of each axis goes to the other")
EKF2_UPDATE = Threshold(0.010, "s", "EKF2_PREDICT_US, EKF2's own step")
NOISE_OFF = Threshold(1.5, "times", "in standard deviation; below, hardly a line moves")
NOISE_OFF_ERROR = Threshold(4.0, "times", "the gain is another one")
OUTLIERS = Threshold(0.005, "of the measurements", "a normal source has 0.02 % beyond 3.7 σ")
OUTLIERS_ERROR = Threshold(0.02, "of the measurements", "every tenth second at 5 Hz")
MIN_OUTLIERS = 3
RECEIPT_JITTER = Threshold(0.010, "s", "1 cm at 1 m/s, a tenth of a good UWB's noise")
LOST_SHARE = Threshold(0.02, "of the source's samples", "seen: 0 to 0.3 %, and 8 to 9 % in v1.13")
# ClockMap.method where no exchange of stamps tied the two clocks together
MAPPED_BY_RECEIPT = ("receive time", "position in the stream", "arrival time")
VISION_PROFILE_BIT = 128  # SDLOG_PROFILE bit 7, logged_topics.cpp
# Intervals (s) at which PX4's default profile thins these topics, logged_topics.cpp
LOGGER_INTERVALS_S = {
    "estimator_visual_odometry_aligned": (0.2,),
    "estimator_aid_src_ev_pos": (0.5,),
    "ekf2_state_plus_innovation": (0.5, 0.2),  # 0.2 in v1.11
}

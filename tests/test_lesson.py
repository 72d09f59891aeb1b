"""Examples 1 and 2 of the lesson, with exactly its numbers."""

from __future__ import annotations

from cli_tools import run

# output as printed in the lesson
EXAMPLE_1 = """\
t 0.5 s: p 0.57 (true 0.50), v 0.57, sigma_p 0.099 m, sigma_v 0.719 m/s
t 1.0 s: p 0.88 (true 1.00), v 0.61, sigma_p 0.097 m, sigma_v 0.262 m/s
t 1.5 s: p 1.48 (true 1.50), v 0.98, sigma_p 0.090 m, sigma_v 0.164 m/s
t 2.0 s: p 2.06 (true 2.00), v 1.07, sigma_p 0.085 m, sigma_v 0.141 m/s
t 2.5 s: p 2.49 (true 2.50), v 0.97, sigma_p 0.082 m, sigma_v 0.137 m/s
t 3.0 s: p 2.93 (true 3.00), v 0.92, sigma_p 0.081 m, sigma_v 0.136 m/s
"""


def test_lesson_kalman_command_prints_output_shown_in_lesson() -> None:
    assert run("lesson", "kalman").output == EXAMPLE_1


# output as printed in the lesson
EXAMPLE_2 = """\
loop closure error (1.2, 0.8) m over 80.4 m = 1.8%
(  0.0,   0.0) -> ( 0.00,  0.00)
( 20.3,   0.2) -> (20.00, -0.00)
( 20.6,  20.4) -> (20.00, 20.00)
(  0.8,  20.9) -> (-0.10, 20.30)
(  1.2,   0.8) -> ( 0.00,  0.00)
"""


def test_lesson_loop_command_prints_output_shown_in_lesson() -> None:
    assert run("lesson", "loop").output == EXAMPLE_2

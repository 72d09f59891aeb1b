"""Flights with known truth and chosen mistakes, as PX4 ULog or in memory.

``scenario`` says what is flown, ``mistakes`` what goes wrong, ``motion`` is the truth in closed
form, ``sensors`` measures it, ``ulog_writer`` writes it, and ``flights`` puts these together.
Scenario and mistakes import nothing heavy: the command line's help is made from them.
"""

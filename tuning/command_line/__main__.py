"""`python -m tuning.command_line`, the same as `mjx-climb`."""

from tuning.command_line import main

main()

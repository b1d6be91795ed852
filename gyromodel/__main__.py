"""`python -m gyromodel` is the command line."""

from gyromodel.cli import main

main()

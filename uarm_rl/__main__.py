"""``python -m uarm_rl`` is the command line."""

from uarm_rl.cli import main

main()

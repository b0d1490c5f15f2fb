"""``python -m uarm_rl`` is the command line."""

from uarm_rl.cli import main

if __name__ == "__main__":
    main()

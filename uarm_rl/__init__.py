"""uarm-rl: train a uArm Swift Pro to reach and suck objects, in simulation and on the desk."""

__version__ = "0.1.0"

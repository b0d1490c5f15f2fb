"""The simulated arm.

Read ``pybullet_arm.py`` first: arm, table and box in PyBullet, behind the task's protocols. ``servo.py`` holds the models of
how joints answer a command.

Uses ``task`` alone.
"""

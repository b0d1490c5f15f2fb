"""The simulated arm.

Read ``simulated_arm.py`` first: arm, table and box behind the task's protocols, as far as they do not depend on the engine.
``pybullet_arm.py`` and ``mujoco_arm.py`` are the engines, ``engines.py`` says which of them there are, ``servo.py`` the models
of how joints answer a command, ``looks.py`` what the arm looks like, ``mujoco_view.py`` MuJoCo's pictures of it, ``trapezoid.py`` the move that the stepper servo and the emulated firmware plan, ``cup.py`` the
cup that gives.

Uses ``task`` alone.
"""

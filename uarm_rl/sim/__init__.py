"""The simulated arm.

Read ``simulated_arm.py`` first: arm, table and box behind the task's protocols, as far as they do not depend on the engine.
``pybullet_arm.py`` and ``mujoco_arm.py`` are the engines, ``engines.py`` says which of them there are, ``servo.py`` the models
of how joints answer a command, ``trapezoid.py`` the move that the stepper servo and the emulated firmware plan, ``cup.py`` the
cup that gives. ``looks.py`` is what the arm looks like; ``backdrop.py`` draws table and shadows for PyBullet, and
``mujoco_view.py`` is MuJoCo's way to draw.

Uses ``task`` alone.
"""

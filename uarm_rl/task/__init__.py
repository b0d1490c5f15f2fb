"""The task, over any arm: what is seen, what is rewarded, how long a command acts, when it is over.

Read ``env.py`` first: the Gymnasium environment, one step a decision. It stands on

- ``arm.py``: what it asks of an arm and of a target (protocols), and the errors of arms
- ``kinematics.py``: geometry of the uArm, limits, angle conventions
- ``observation.py``, ``reward.py``, ``hold.py``: the 20 numbers or more, equation (4), how long a command acts
- ``within.py``: the control steps of a held decision, as decisions that might have begun there
- ``obstacles.py``: boxes in the way, and how near all of the arm comes to them
- ``layouts.py``: what stands where when an attempt begins, and that there is a way
- ``positions.py``: where the object may lie, and the committed files of positions

and on it stand ``policy.py`` (a trained actor as one file, the inverse-kinematics baseline), ``planner.py`` (a library's motion
planner) and ``rollout.py`` (one episode).

Uses no other wing; every wing uses this one. Only ``env.py`` needs Gymnasium, and ``planner.py`` OMPL;
nothing needs torch or PyBullet.
"""

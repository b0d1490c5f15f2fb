"""The learner.

Read ``train.py`` first: the loop, and nothing else; ``driver.py`` drives one of them, or many whose learners lie in a
``stack.py``. What the loop is handed is one ``learner.py``, which can be saved and restored:

- ``ddpg.py`` on ``actor_critic.py`` and ``network.py``: the agent, its gradient step, and the networks with their backward pass
  written out
- ``replay.py``, ``admission.py``, ``returns.py``, ``hindsight.py``, ``sampling.py``, ``noise.py``: what is stored,
  what may enter, what it says of the future and of other targets, what is drawn, and exploration
- ``async_env.py``: the environment whose step is in two halves, here or in a process of its own

``sb3.py`` has other learners, Stable-Baselines3's, and makes policies of them; ``sb3_training.py`` trains these.

``run.py`` keeps a training in its folder: claim, progress, validation, stop, resume; ``checkpoint.py`` is what is on
disk, ``loggers.py`` who else is told.

Uses ``task`` alone; the only owner of torch. Knows nothing of PyBullet, configuration files or commands.
"""

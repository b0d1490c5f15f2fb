"""The task: geometry, observation, reward, how long a command acts, and the environment over any arm."""

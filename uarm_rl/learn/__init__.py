"""The learner: networks, replay, what may enter it, noise, the loop, and a run in its folder."""

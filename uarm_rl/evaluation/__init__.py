"""Testing policies on fixed positions, and filming them.

Read ``evaluate.py`` first: one episode a position, in as many processes as wanted. ``measures.py`` makes an episode's row;
``film.py`` its pictures.

Uses ``task`` alone, for any environment and any policy.
"""

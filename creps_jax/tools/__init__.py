"""Use what was learned: play, export, train on a real robot. `creps-jax` is the command; it needs the extra
`tools`.
"""

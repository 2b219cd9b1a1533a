"""Play and export learned policies, learn on a real robot: the command `creps-jax`, of the extra `tools`."""

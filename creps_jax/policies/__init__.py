"""What is learned: a distribution of parameters for each context."""

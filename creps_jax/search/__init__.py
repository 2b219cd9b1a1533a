"""How to search: contextual REPS, from rewards to a new policy."""

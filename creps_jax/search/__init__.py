"""Search methods: contextual REPS, from rewards to a new policy."""

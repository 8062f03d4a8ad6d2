"""One documented function per job: what the commands call, and what Python users call too."""

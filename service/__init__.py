"""The bake service: HTTP in front, a job store, a scheduler and workers behind; and the command line."""

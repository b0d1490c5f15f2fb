"""Tables and figures, from the CSV files of the runs and nothing else."""

"""Studies: thousands of scores and searches, as a list of jobs that any number of workers do."""

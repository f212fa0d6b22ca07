"""Studies: thousands of scores and searches, as a list of jobs for any number of workers."""

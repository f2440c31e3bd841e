"""What can be done with a run folder: work on it, read it, fork it, evaluate it, export it, send it as a job."""

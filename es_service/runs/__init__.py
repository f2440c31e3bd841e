"""Operations on run folders: run, read, fork, evaluate, export, and submit as a job."""

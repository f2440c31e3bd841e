"""The main loop (`driver.py`) and the parts of a generation; independent of files, of Ray and of any single method."""

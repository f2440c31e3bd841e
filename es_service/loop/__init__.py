"""The loop (`driver.py`) and what a generation is made of. It knows no files, no Ray and no method by name."""

"""The command line: what a person types and reads. Nothing imports it but `__main__`."""

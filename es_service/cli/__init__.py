"""The command line: commands, options and printed tables. Only `es_service.__main__` imports this package."""

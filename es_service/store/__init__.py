"""The run store: one SQLite file per run, one transaction per generation, verified when opened.

`writer.py` is the one writer, `reader.py` what everybody else uses. `create`, `verify`, `repair` and `upkeep` are what
the writer does before and besides committing; `schema`, `codec`, `folder` and `lock` are what all of them share.
"""

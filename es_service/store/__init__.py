"""The run store: one SQLite file per run with one transaction per generation, verified when it is opened for writing.

`writer.py` has the only writer, and all readers use `reader.py`. `create`, `beginning`, `repair` and `upkeep` are parts
of the writer; `verify`, `schema`, `codec`, `folder` and `lock` are shared. `digest.py` computes the digest of a run.
"""

"""The run store: one SQLite file per run with one transaction per generation, verified when it is opened for writing.

`writer.py` has the only writer; `create`, `beginning`, `repair` and `upkeep` are parts of it. Whoever reads stored rows
does so by `rows.py` and `states.py`: `reader`, `sound` (for reports, also of damaged runs), `verify` and `digest`.
"""

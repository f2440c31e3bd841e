"""The run store: one SQLite file per run with one transaction per generation, verified when it is opened for writing.

`writer.py` has the only writer; `create`, `repair` and `upkeep` are parts of it. Whoever reads what is stored does so
by `rows.py`, `states.py` and `records.py`: `reader`, `sound` (for reports, also of damaged runs), `verify`, `digest`.
"""

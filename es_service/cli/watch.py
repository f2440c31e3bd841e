"""The command `watch`: the live page of runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from es_service.cli.commands import evaluation_of
from es_service.cli.options import print_note
from es_service.errors import ConfigError, WayOut
from es_service.protocol.system import given_path


def watch(
    folders: Annotated[
        list[Path],
        typer.Argument(
            parser=given_path, metavar="FOLDER...", help="Folders with runs below them.", show_default=False
        ),
    ],
    host: Annotated[
        str, typer.Option("--host", help="Address to listen on; another than this machine's own needs a token.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="Port to listen on; 0 for a free one.")] = 8642,
    trust: Annotated[
        bool, typer.Option("--trust", help="Let replays execute code of users that configs of the runs name.")
    ] = False,
) -> None:
    """Serve a page that shows all runs below some folders while they run; Ctrl-C ends it."""
    try:
        from es_service.watch.server import serve
    except ModuleNotFoundError as error:
        if error.name not in ("starlette", "uvicorn"):
            raise
        ways_out = [WayOut("install", "install it", extra="watch")]
        raise ConfigError(f"watch needs {error.name}", field="watch", ways_out=ways_out) from error
    for folder in folders:
        if not folder.exists():
            print_note(f"note: {folder} does not exist yet")
        elif not folder.is_dir():
            raise ConfigError(f"{folder} is a file; give the folder of a run, or one that contains runs")

    def show(address: str) -> None:
        print(address, flush=True)
        if "?token=" in address:
            print_note("note: whoever has this address can see the page, and have replays recorded; it is not shown "
                       "again. It is sent without encryption.")  # fmt: skip

    serve(folders, evaluation_of, show, host=host, port=port, trusted=trust)

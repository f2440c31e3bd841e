"""The dispatch log survives what cuts its lines short."""

import os
from contextlib import suppress

import pytest

from es_service.dispatch.events import FILE, Committed, dispatch_log
from es_service.errors import StoreError
from tests.dispatch_checker import read_dispatch_log


def test_sessions_append_and_torn_lines_are_left_out(tmp_path):
    with dispatch_log(tmp_path, None, enabled=True) as log:
        log(Committed(0))
    whole = (tmp_path / FILE).read_bytes()
    (tmp_path / FILE).write_bytes(whole[:-9])  # as a full disk or a kill leaves it
    with dispatch_log(tmp_path, 0, enabled=True) as log:
        log(Committed(1))
    entries = read_dispatch_log(tmp_path)
    assert [entry["is"] for entry in entries] == ["Session", "Session", "Committed"]
    assert entries[1]["after_generation"] == 0
    assert entries[2]["generation"] == 1


def test_without_it_nothing_is_written(tmp_path):
    with dispatch_log(tmp_path, None, enabled=False) as log:
        log(Committed(0))
    assert not list(tmp_path.iterdir())


def test_a_file_that_cannot_be_opened_is_an_error_of_the_folder(tmp_path):
    (tmp_path / FILE).mkdir()
    with (
        pytest.raises(StoreError, match=r"opening dispatch\.jsonl"),
        dispatch_log(tmp_path, None, enabled=True),
    ):
        raise AssertionError("nothing can be logged")


@pytest.mark.parametrize("begun", [False, True])
def test_a_full_disk_is_an_error_of_the_folder_from_the_first_byte_on(small_disk, begun):
    """Whether the file is new, or there is a line to be ended first."""
    if begun:
        (small_disk / FILE).write_bytes(bytes(os.statvfs(small_disk).f_bsize))  # the next byte needs another block
    with suppress(OSError), (small_disk / "filling").open("wb", buffering=0) as filling:
        while filling.write(bytes(4096)):
            pass
    with (
        pytest.raises(StoreError, match=r"disk full while writing dispatch\.jsonl"),
        dispatch_log(small_disk, None, enabled=True),
    ):
        raise AssertionError("nothing can be logged")

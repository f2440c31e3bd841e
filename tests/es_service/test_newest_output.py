"""What processes print: the newest is kept, however much it is, and nothing else."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import threading
import time

import pytest

from es_service.protocol.process_environment import NewestOutput

MOST = 100_000
LOUD = """
import os, subprocess, sys

for number in range(200_000):
    os.write(1, b"line %d\\n" % number)
    if number == 100_000:
        subprocess.run([sys.executable, "-c", "import os\\nfor number in range(100_000): os.write(2, b'a child\\\\n')"])
os.write(1, b"the last line\\n")
os.kill(os.getpid(), 9)
"""


def test_of_what_a_process_and_its_children_write_the_newest_is_there_after_a_kill():
    before = threading.active_count(), len(os.listdir("/proc/self/fd"))
    with tempfile.TemporaryFile() as file:
        output = NewestOutput()
        watched = output.add(file.fileno(), MOST)
        process = subprocess.Popen([sys.executable, "-c", LOUD], stdout=file, stderr=file)
        sizes = []
        while process.poll() is None:
            sizes.append(os.fstat(file.fileno()).st_size)
            time.sleep(0.001)
        output.forget(watched)
        assert process.returncode == -signal.SIGKILL
        assert max(sizes) < 1_500_000, "of more than 3 MB"
        file.seek(0)
        text = file.read()
    assert MOST // 4 < len(text) < 1_500_000
    assert text.endswith(b"line 199999\nthe last line\n")
    assert (threading.active_count(), len(os.listdir("/proc/self/fd"))) == before


def test_a_file_that_is_forgotten_stays_as_it_is():
    output = NewestOutput()
    with tempfile.TemporaryFile() as file, tempfile.TemporaryFile() as other:
        watched = output.add(file.fileno(), 1000)
        last = output.add(other.fileno(), 1000)
        output.forget(watched)
        for one in (file, other):
            os.write(one.fileno(), b"x" * 5000)
        until = time.monotonic() + 10.0
        while os.fstat(other.fileno()).st_size != 500 and time.monotonic() < until:  # 0 in the middle of a cut
            time.sleep(0.01)
        assert [os.fstat(one.fileno()).st_size for one in (file, other)] == [5000, 500]
        output.forget(last)
        output.forget(watched)


def test_a_pipe_is_refused():
    ends = os.pipe()
    with pytest.raises(OSError, match="no regular file"):
        NewestOutput().add(ends[1], 1000)
    for end in ends:
        os.close(end)

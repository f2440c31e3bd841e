"""How large is the code? Lines and files of Python by room, and of all; two checkouts side by side.

python -m tests.benchmarks.code_size [OTHER_CHECKOUT]
"""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path


def sizes(root: Path) -> tuple[Counter[str], Counter[str]]:
    """(lines, files) of each room: a folder of `es_service` or `workers`, or what lies beside them."""
    lines, files = Counter[str](), Counter[str]()
    for package in ("es_service", "workers"):
        for file in (root / package).rglob("*.py"):
            inside = file.relative_to(root).parts[:-1][:2]
            for room in ("/".join(inside), "all"):
                lines[room] += len(file.read_text().splitlines())
                files[room] += 1
    return lines, files


def main() -> None:
    here = Path(__file__).parents[2]
    checkouts = [sizes(Path(path)) for path in (*sys.argv[1:2], here)]
    rooms = sorted({room for lines, _ in checkouts for room in lines} - {"all"})
    for room in (*rooms, "all"):
        print(f"{room:28}", *(f"{lines[room]:8,} lines {files[room]:4} files" for lines, files in checkouts))


if __name__ == "__main__":
    main()

"""Evolution strategies for neuro-evolution: `from es_service import load_config, run, open_run`, and `plots`.

Names are imported at their first use, so that importing one module does not import everything.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from es_service.api import Observer, Stop, evaluator, fork, load_config, open_run, resume, run, run_or_resume
    from es_service.asking import ask_tell
    from es_service.dispatch.staying import workers
    from es_service.report import plots
    from es_service.report.write import write_comparison, write_report
    from es_service.runs.certification import certify, certify_run
    from es_service.runs.lineage import polish_config
    from es_service.runs.sweep import sweep

    __version__: str

__all__ = [
    "Observer",
    "Stop",
    "__version__",
    "ask_tell",
    "certify",
    "certify_run",
    "evaluator",
    "fork",
    "load_config",
    "open_run",
    "plots",
    "polish_config",
    "resume",
    "run",
    "run_or_resume",
    "sweep",
    "workers",
    "write_comparison",
    "write_report",
]
_MODULES = {
    "ask_tell": "es_service.asking",
    "certify": "es_service.runs.certification",
    "certify_run": "es_service.runs.certification",
    "polish_config": "es_service.runs.lineage",
    "sweep": "es_service.runs.sweep",
    "write_comparison": "es_service.report.write",
    "write_report": "es_service.report.write",
    "workers": "es_service.dispatch.staying",
}
"""Name -> its module, if that is not `es_service.api`."""


def __dir__() -> list[str]:
    return sorted(__all__)  # for completion, which would otherwise see only what has been used


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if name == "__version__":
        from es_service.protocol.machine import VERSION

        return VERSION
    if name == "plots":
        return importlib.import_module("es_service.report.plots")
    return getattr(importlib.import_module(_MODULES.get(name, "es_service.api")), name)

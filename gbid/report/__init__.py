"""Report: tables, figures and the data behind them.

The public names are those of the stub beside this file, ``__init__.pyi``. Figures are imported at their first use,
because only they need matplotlib.
"""

from typing import Any

from gbid.core.public import attach


def _around(*call: Any) -> Any:
    from gbid.report.canvas import around_public

    return around_public(*call)


__getattr__, __dir__, __all__ = attach(__name__, __file__, _around)

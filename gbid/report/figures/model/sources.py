"""Models of a figure: one or several, with their labels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from gbid.errors import UsageError
from gbid.identify.curves.uncertain_model import ModelLike, UncertainModel, as_uncertain

Sources = ModelLike | Sequence[ModelLike] | Mapping[str, ModelLike]
"""A `LinearModel` or `FitResult`, several of them, or several by label."""


def labelled(sources: Sources) -> dict[str, UncertainModel]:
    """Return the models of a figure by label; without labels, by their names, numbered where they are equal.

    Parameters
    ----------
    sources : LinearModel or FitResult, sequence of them, or dict of str to them
        The models.

    Returns
    -------
    dict of str to UncertainModel

    Raises
    ------
    UsageError
        When there is no model, when one of them is something else, or when their channels differ in number.
    """
    if isinstance(sources, Mapping):
        found = {label: as_uncertain(source) for label, source in sources.items()}
    else:
        models = [as_uncertain(s) for s in (sources if isinstance(sources, Sequence) else [sources])]
        names = [m.model.name for m in models]
        numbered = [f"{name} ({i})" if names.count(name) > 1 else name for i, name in enumerate(names, 1)]
        found = dict(zip(numbered, models, strict=True))
    if not found:
        raise UsageError("no model to draw; give at least one")
    shapes = {label: m.model.D.shape for label, m in found.items()}
    if len(set(shapes.values())) > 1:
        listed = ", ".join(f"{label} {n_y} x {n_u}" for label, (n_y, n_u) in shapes.items())
        raise UsageError(f"models with different numbers of outputs and inputs in one figure: {listed}")
    return found

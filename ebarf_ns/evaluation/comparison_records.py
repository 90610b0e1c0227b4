"""The records of a comparison of methods, one per training."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

Record = dict[str, Any]
Panels = dict[tuple[str, str], list[Record]]
POSE_ERRORS = ("ate_m", "rotation_deg")
AS_GOOD_AS_NOTHING = 1e-7
_HUGE = 1e300
TOLERANCES = (0.1, 0.01, 0.001)


def refining_records(result: dict[str, Any]) -> list[Record]:
    """The records of methods that refine poses, without baselines."""
    return [record for record in result["records"] if result["roles"].get(record["method"], "method") == "method"]


def error_of(evaluation: Record, name: str) -> float:
    """One error of an evaluation, smaller is better; infinite if unknown."""
    if name == "image":
        psnr = evaluation.get("psnr")
        return math.inf if psnr is None else 10 ** (-psnr / 20)
    value = evaluation.get(name)
    if value is None and name == "ate_m":
        # On a line, only orientation and scale can be aligned.
        value = evaluation.get("ate_m_orientation")
    return math.inf if value is None else float(value)


def last_evaluation(record: Record) -> Record:
    """The last evaluation; empty if the training failed or is missing, which counts as infinite error."""
    return record["evaluations"][-1] if record.get("evaluations") else {}


def seconds_to(records: Sequence[Record], name: str, target: float) -> float:
    """Training time until an error is at most ``target`` in trainings of one problem; infinite if never reached."""
    reached = [
        evaluation["train_seconds"]
        for record in records
        for evaluation in record["evaluations"]
        if error_of(evaluation, name) <= target
    ]
    return min(reached, default=math.inf)


def by_problem(records: Sequence[Record], *keys: str) -> dict[tuple, list[Record]]:
    """Records grouped by the given keys, in order of appearance."""
    groups: dict[tuple, list[Record]] = {}
    for record in records:
        groups.setdefault(tuple(record[key] for key in keys), []).append(record)
    return groups


def panels_of(records: Sequence[Record], roles: dict[str, str]) -> Panels:
    """The records of each scene and trajectory; floors appear in all panels of their scene."""
    floors = [record for record in records if roles.get(record["method"]) == "floor"]
    others = [record for record in records if roles.get(record["method"]) != "floor"]
    panels = by_problem(others, "scene", "trajectory")
    return {
        (scene, trajectory): [*own, *(floor for floor in floors if floor["scene"] == scene)]
        for (scene, trajectory), own in panels.items()
    }


def quartiles(errors: Sequence[float]) -> Float[np.ndarray, "3"]:
    """First quartile, median and third quartile; infinite where a failed training contributes."""
    found = np.quantile(np.minimum(errors, _HUGE), (0.25, 0.5, 0.75))
    return np.where(found > math.sqrt(_HUGE), math.inf, found)

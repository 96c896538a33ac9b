"""One line of the parity table, and the tally that it is made from."""

import dataclasses
from typing import Any

import numpy as np


@dataclasses.dataclass(frozen=True)
class Row:
    """How far one component is from its counterpart in Stone Soup.

    Attributes:
        component: ours, as module and function.
        stone_soup: the class it stands for.
        compared: how many results were compared.
        unit: what was counted.
        float64: largest error in double precision with the exact Jacobian; None where only
            decisions are compared.
        float32: largest error in single precision; None where it was not measured.
        stock: largest error in double precision against the bare stock initiator, None where
            the initiator plays no part.
        agreement: share of decisions (gate, association, birth, deletion) that are the same
            outside exact ties; None where nothing is decided.
        agreement32: the same in single precision.
        agreement_stock: the same against the bare stock initiator.
        ties: exact ties met, which are left out.
        tolerance: largest error in float64 that passes.
        note: what a reader must know of this row.
    """

    component: str
    stone_soup: str
    compared: int
    unit: str
    float64: float | None
    float32: float | None = None
    stock: float | None = None
    agreement: float | None = None
    agreement32: float | None = None
    agreement_stock: float | None = None
    ties: int = 0
    tolerance: float = 1e-9
    note: str = ""

    @property
    def passed(self) -> bool:
        """Whether something was compared, the error is within tolerance and every decision agrees.

        In float64 with the exact Jacobian: what float32 and the bare stock initiator do is
        published, and has no limit.
        """
        measured = self.float64 is not None or self.agreement is not None
        small = self.float64 is None or self.float64 <= self.tolerance
        return self.compared > 0 and measured and small and self.agreement in (None, 1.0)


class Tally:
    """Errors and decisions of one component, collected in one precision or variant."""

    def __init__(self) -> None:
        self.compared = 0
        self.largest: float | None = None
        self.same = 0
        self.decided = 0

    def error(self, value: float) -> None:
        """Takes one result's error; NaN stays and fails every tolerance."""
        self.compared += 1
        self.largest = float(np.maximum(value, 0.0 if self.largest is None else self.largest))

    def decision(self, same: bool) -> None:
        """Takes one decision."""
        self.decided += 1
        self.same += bool(same)

    @property
    def agreement(self) -> float | None:
        """Share of the decisions that agree; None without any."""
        return self.same / self.decided if self.decided else None

    def row(self, component: str, stone_soup: str, unit: str, **extra: Any) -> Row:
        """The line that this tally makes in float64."""
        compared = self.compared or self.decided
        return Row(component, stone_soup, compared, unit, self.largest, agreement=self.agreement, **extra)

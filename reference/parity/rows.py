"""One line of the parity table."""

import dataclasses


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
    ties: int = 0
    tolerance: float = 1e-9
    note: str = ""

    @property
    def passed(self) -> bool:
        """Whether something was compared, the error is within tolerance and every decision agrees."""
        small = self.float64 is None or self.float64 <= self.tolerance
        return self.compared > 0 and small and self.agreement in (None, 1.0)

"""The tracking metrics beside Stone Soup's generators, over whole records."""

import dataclasses
from collections.abc import Callable, Iterator, Sequence

import jax
import numpy as np

from jaxtrack import metrics, pcrb
from jaxtrack.params import Params
from jaxtrack.siap import siap
from jaxtrack.types import Tracks, Truths
from reference.components import step_duration
from reference.parity.compare import TOLERANCE, covariance_error
from reference.parity.ours import on_device
from reference.parity.records import Record
from reference.parity.rows import Row
from reference.parity.stock_metrics import (
    GOSPA_PARTS,
    Numbers,
    StockRecord,
    stock_basic,
    stock_gospa,
    stock_norms,
    stock_pcrb,
    stock_siap,
)

Ours = dict[str, jax.Array]


def largest_error(ours: Numbers, theirs: Numbers) -> float:
    """Largest |a - b| / max(1, |b|), units as they are, over the numbers that Stone Soup has."""
    errors = [0.0]
    for name, value in theirs.items():
        known = ~np.isnan(value)
        difference = np.abs(np.asarray(ours[name], float)[known] - value[known])
        errors.append(np.max(difference / np.maximum(1.0, np.abs(value[known])), initial=0.0))
    return float(np.max(errors))


def bound_error(ours: Numbers, theirs: Numbers) -> float:
    """Largest error of the two root mean squares, and of the covariance in its own sigmas."""
    known = ~np.isnan(theirs["position"])
    of_covariance = covariance_error(ours["covariance"][known], theirs["covariance"][known])
    roots = {name: theirs[name] for name in ("position", "velocity")}
    return float(np.max([largest_error(ours, roots), of_covariance]))


@dataclasses.dataclass(frozen=True)
class Comparison:
    """One metric on both sides.

    Attributes:
        component: ours, as module and function.
        stone_soup: the class it stands for.
        ours: numbers by name, from truths, tracks, times (s) and parameters.
        theirs: numbers by name, of which ours has at least these; NaN is not compared.
        note: what a reader must know.
        error: largest error of ours against theirs.
        slow: whether the limit on the number of records applies.
        switching: whether a record without a switching penalty gets one.
    """

    component: str
    stone_soup: str
    ours: Callable[[Truths, Tracks, jax.Array, Params], Ours]
    theirs: Callable[[StockRecord], Numbers]
    note: str = ""
    error: Callable[[Numbers, Numbers], float] = largest_error
    slow: bool = False
    switching: bool = False

    def prepare(self, record: Record) -> Record:
        """The record with a switching penalty, half the cut-off, or with none."""
        penalty = record.params.gospa_switching_penalty or record.params.gospa_cutoff / 2
        penalty = penalty if self.switching else 0.0
        params = dataclasses.replace(record.params, gospa_switching_penalty=penalty)
        return dataclasses.replace(record, params=params)


def metric_rows(records: Sequence[Record], limit: int | None = None) -> Iterator[Row]:
    """Every metric on every record, in float64 and in float32.

    Args:
        records: those of equal shapes are compiled once.
        limit: records on which SIAP and PCRB, which are slow in Stone Soup, are compared; unset, all.
    """
    for one in COMPARISONS:
        yield compare(one, records[: limit if one.slow else None])


def compare(comparison: Comparison, records: Sequence[Record]) -> Row:
    """One metric on all records; errors as `Comparison.error` measures them."""
    compared = ties = 0
    double, single = [0.0], [0.0]
    for record in map(comparison.prepare, records):
        theirs = comparison.theirs(StockRecord(record))
        compared += sum(int(np.sum(~np.isnan(value))) for value in theirs.values())
        ties += int(np.isnan(theirs.get("track_change_rate", 0.0)))
        double.append(comparison.error(our_numbers(comparison, record, double=True), theirs))
        single.append(comparison.error(our_numbers(comparison, record, double=False), theirs))
    return Row(
        component=comparison.component,
        stone_soup=comparison.stone_soup,
        compared=compared,
        unit="values",
        float64=float(np.max(double)),  # NaN stays NaN, and passes no tolerance
        float32=float(np.max(single)),
        ties=ties,
        tolerance=TOLERANCE,
        note=comparison.note,
    )


def our_numbers(comparison: Comparison, record: Record, double: bool) -> Numbers:
    """Our numbers, computed in float64 or float32 from inputs of that precision."""
    times = np.arange(len(record.truths.alive)) * step_duration(record.params).total_seconds()
    compiled = _COMPILED[comparison.component]
    return on_device(compiled, double, record.truths, record.tracks, times, record.params)


def our_norms(truths: Truths, tracks: Tracks, times: jax.Array, params: Params) -> Ours:
    """Sum and mean of the covariance norms `[K]`."""
    del truths, times, params
    return {
        "sum": jax.vmap(metrics.covariance_norm_sum)(tracks),
        "mean": jax.vmap(metrics.covariance_norm_mean)(tracks),
    }


def our_gospa(truths: Truths, tracks: Tracks, times: jax.Array, params: Params) -> Ours:
    """GOSPA of every step by itself."""
    del times
    found = jax.vmap(metrics.gospa, in_axes=(0, 0, None))(truths, tracks, params)
    return {part: getattr(found, part) for part in GOSPA_PARTS}


def our_gospa_over_time(truths: Truths, tracks: Tracks, times: jax.Array, params: Params) -> Ours:
    """GOSPA with its switching penalty."""
    del times
    found = metrics.gospa_over_time(truths, tracks, params)
    return {part: getattr(found, part) for part in GOSPA_PARTS}


def our_siap(truths: Truths, tracks: Tracks, times: jax.Array, params: Params) -> Ours:
    """SIAP totals and, per step, `..._at_times`."""
    found = dict(vars(siap(truths, tracks, times, params)))
    at_times = vars(found.pop("at_times"))
    return found | {f"{name}_at_times": value for name, value in at_times.items()}


def our_basic(truths: Truths, tracks: Tracks, times: jax.Array, params: Params) -> Ours:
    """Counts of tracks and truths."""
    del times, params
    return vars(metrics.basic_metrics(truths, tracks))


def our_pcrb(truths: Truths, tracks: Tracks, times: jax.Array, params: Params) -> Ours:
    """Bounds with the prior of a new track."""
    del tracks
    return vars(pcrb.bounds(truths, times, params))


COMPARISONS = (
    Comparison(
        "metrics.covariance_norm_sum, _mean",
        "SumofCovarianceNormsMetric, MeanofCovarianceNormsMetric",
        our_norms,
        stock_norms,
    ),
    Comparison(
        "metrics.gospa", "GOSPAMetric", our_gospa, stock_gospa, "distance, localisation, missed, false"
    ),
    Comparison(
        "metrics.gospa_over_time",
        "GOSPAMetric",
        our_gospa_over_time,
        stock_gospa,
        "with a switching penalty",
        switching=True,
    ),
    Comparison(
        "siap.siap",
        "SIAPMetrics, TrackToTruth",
        our_siap,
        stock_siap,
        "seven totals, five of them also per step; ties are rates of track number change that "
        "depend on the order of a Python set",
        slow=True,
    ),
    Comparison("metrics.basic_metrics", "BasicMetrics", our_basic, stock_basic),
    Comparison(
        "pcrb.bounds",
        "PCRBMetric",
        our_pcrb,
        stock_pcrb,
        "exact Jacobian, and sensor locations as columns, without which the stock class fails",
        error=bound_error,
        slow=True,
    ),
)

_COMPILED = {one.component: jax.jit(one.ours) for one in COMPARISONS}

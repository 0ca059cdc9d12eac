"""Metrics against answers worked out by hand."""

import numpy as np
import pytest

from pnv_lab.evaluation.metrics import (
    Decisions,
    average_precision,
    bootstrap,
    first_hits,
    precision_recall,
    recall_at,
    recall_at_full_precision,
    unique_groups,
)


def rows(*lists: list[int]) -> list[np.ndarray]:
    return [np.array(row, np.int64) for row in lists]


def test_recall_counts_queries_whose_true_reference_is_among_the_first() -> None:
    hits = first_hits(rows([3, 1, 2], [0, 5, 4], [7, 8, 9]), rows([3], [4, 6], [1]))
    assert hits.tolist() == [0, 2, -1]
    assert [recall_at(hits, n) for n in (1, 2, 3)] == pytest.approx([1 / 3, 1 / 3, 2 / 3])


def test_queries_without_a_true_reference_are_not_counted() -> None:
    hits = first_hits(rows([0], [1]), rows([], [1]))
    assert hits.tolist() == [0]
    assert recall_at(hits, 1) == 1.0


def test_cut_outs_of_one_panorama_count_once() -> None:
    groups = np.array([0, 0, 0, 1, 1, 2])
    assert unique_groups(np.array([4, 1, 0, 3, 5]), groups).tolist() == [4, 1, 5]


# Five queries; the fourth has no true reference anywhere, the fifth's was missed.
FIVE = Decisions(
    np.array([0.9, 0.8, 0.7, 0.6, 0.5]),
    np.array([True, True, False, False, True]),
    np.array([True, True, True, False, True]),
)


def test_precision_and_recall_of_five_decisions() -> None:
    thresholds, precision, recall = precision_recall(FIVE)
    assert thresholds.tolist() == [0.9, 0.8, 0.7, 0.6, 0.5]
    assert precision == pytest.approx([1, 1, 2 / 3, 2 / 4, 3 / 5])
    assert recall == pytest.approx([1 / 4, 2 / 4, 2 / 4, 2 / 4, 3 / 4])


def test_average_precision_and_recall_at_full_precision_of_five_decisions() -> None:
    assert average_precision(FIVE) == pytest.approx(0.25 * 1 + 0.25 * 1 + 0.25 * 0.6)
    assert recall_at_full_precision(FIVE) == 0.5


def test_equal_scores_are_accepted_together() -> None:
    tied = Decisions(np.array([0.9, 0.9, 0.1]), np.array([True, False, True]), np.array([True, True, True]))
    thresholds, precision, recall = precision_recall(tied)
    assert thresholds.tolist() == [0.9, 0.1]
    assert precision == pytest.approx([1 / 2, 2 / 3])
    assert recall == pytest.approx([1 / 3, 2 / 3])
    assert recall_at_full_precision(tied) == 0.0


def test_a_query_without_candidate_answers_nothing() -> None:
    silent = Decisions(np.array([-np.inf, 0.4]), np.array([False, True]), np.array([True, True]))
    assert precision_recall(silent)[1].tolist() == [1.0]
    assert recall_at_full_precision(silent) == 0.5


def test_bootstrap_of_a_proportion_agrees_with_the_binomial_law() -> None:
    hits = np.repeat([1.0, 0.0], [70, 30])
    interval = bootstrap(lambda drawn: float(hits[drawn].mean()), 100, samples=4000)
    half = 1.96 * np.sqrt(0.7 * 0.3 / 100)
    assert interval.value == pytest.approx(0.7)
    assert interval.low == pytest.approx(0.7 - half, abs=0.015)
    assert interval.high == pytest.approx(0.7 + half, abs=0.015)


def test_bootstrap_gives_the_same_interval_every_time() -> None:
    data = np.arange(20.0)
    assert bootstrap(lambda i: float(data[i].mean()), 20) == bootstrap(lambda i: float(data[i].mean()), 20)

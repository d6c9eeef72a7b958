"""What came or went as one body, told from what is hit and looked through without order."""

from __future__ import annotations

import numpy as np

from recon.core.kernels.voxels import pack_keys
from recon.map.occupancy.bodies import came_or_went

WALL = np.stack(np.meshgrid(np.arange(8), [0], np.arange(8)), -1).reshape(-1, 3)
FRAMES = 30


def _judged(cells: np.ndarray, seen: np.ndarray, placed: np.ndarray | None = None) -> np.ndarray:
    """Judge cells (N, 3) of which frames saw (F, N)."""
    keys = pack_keys(cells)
    order = np.argsort(keys)
    sure = np.ones(len(cells), np.bool_) if placed is None else placed
    judged = np.zeros(len(cells), np.bool_)
    judged[order] = came_or_went(keys[order], sure[order], seen[:, order].astype(np.int8))
    return judged


def _while(frames: slice, number: int) -> np.ndarray:
    seen = np.full((FRAMES, number), -1)
    seen[frames] = 1
    return seen


def test_what_was_there_as_a_whole_for_a_while_came_or_went() -> None:
    assert _judged(WALL, _while(slice(10, 15), len(WALL))).all()


def test_two_that_pass_one_after_the_other_both_moved() -> None:
    seen = _while(slice(4, 7), len(WALL))
    seen[20:24] = 1
    assert _judged(WALL, seen).all()


def test_what_enters_a_place_by_one_edge_moved() -> None:
    # Column after column is hit, each for six frames.
    since = np.arange(FRAMES)[:, None] - 2 * WALL[:, 0]
    assert _judged(WALL, np.where((since >= 3) & (since < 9), 1, -1)).all()


def test_what_each_frame_hits_at_random_did_not_move() -> None:
    for share in (0.1, 0.3, 0.5):
        rng = np.random.default_rng(3)
        seen = np.where(rng.random((FRAMES, len(WALL))) < share, 1, -1)
        assert not _judged(WALL, seen).any()


def test_boards_of_a_fence_that_some_frames_hit_and_others_do_not_did_not_move() -> None:
    # Each board is hit or looked through from top to bottom, whatever the others are.
    rng = np.random.default_rng(5)
    boards = rng.random((FRAMES, 8)) < 0.3
    assert not _judged(WALL, np.where(boards[:, WALL[:, 0]], 1, -1)).any()


def test_what_was_hit_or_looked_through_by_all_frames_did_not_move() -> None:
    assert not _judged(WALL, np.ones((FRAMES, len(WALL)))).any()
    assert not _judged(WALL, np.full((FRAMES, len(WALL)), -1)).any()
    assert not _judged(WALL, np.zeros((FRAMES, len(WALL)))).any()


def test_pieces_are_judged_apart() -> None:
    cells = np.concatenate([WALL, WALL + np.array([20, 0, 0])])
    rng = np.random.default_rng(7)
    noise = np.where(rng.random((FRAMES, len(WALL))) < 0.4, 1, -1)
    judged = _judged(cells, np.concatenate([_while(slice(5, 9), len(WALL)), noise], axis=1))
    assert judged[: len(WALL)].all()
    assert not judged[len(WALL) :].any()


def test_a_cell_alone_moved_if_it_was_hit_in_one_run_of_frames() -> None:
    cell = WALL[:1]
    assert _judged(cell, _while(slice(3, 5), 1)).all()
    twice = _while(slice(3, 5), 1)
    twice[9] = 1
    assert not _judged(cell, twice).any()
    never_through = np.zeros((FRAMES, 1), np.int8)
    never_through[3:5] = 1
    assert not _judged(cell, never_through).any()


def test_cells_that_frames_could_place_outweigh_the_others_of_their_piece() -> None:
    placed = WALL[:, 0] < 3
    rng = np.random.default_rng(9)
    noise = np.where(rng.random((FRAMES, len(WALL))) < 0.4, 1, -1)
    body = _while(slice(5, 9), len(WALL))
    assert _judged(WALL, np.where(placed, body, noise), placed).all()
    assert not _judged(WALL, np.where(placed, noise, body), placed).any()
    assert _judged(WALL, body, np.zeros(len(WALL), np.bool_)).all()


def test_cells_of_which_too_little_is_known_belong_to_a_body_beside_them() -> None:
    beside = [[9, 0, 0], [12, 0, 0]]  # each two cells from the one before, both alone
    seen = np.concatenate([_while(slice(5, 9), len(WALL)), np.zeros((FRAMES, 2))], axis=1)
    assert _judged(np.concatenate([WALL, beside]), seen)[len(WALL) :].tolist() == [True, False]


def test_nothing_is_judged_to_be_nothing() -> None:
    assert len(_judged(WALL[:0], np.zeros((FRAMES, 0)))) == 0

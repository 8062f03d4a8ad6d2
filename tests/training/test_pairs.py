from __future__ import annotations

import dataclasses
import itertools
import math
import pickle
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from psiamfcpp.crop import crop, mean_colour, warp
from psiamfcpp.datasets import Sequence
from psiamfcpp.datasets.frames import FrameStore, video_frames
from psiamfcpp.errors import UserError
from psiamfcpp.images import read_image
from psiamfcpp.models.arch import ARCHITECTURES, architecture
from psiamfcpp.training.options import PairOptions
from psiamfcpp.training.pairs import ImageCache, Jitter, Pair, PairSampler, box_in_crop, crop_map

from .conftest import colour, coloured, paint

PLAIN = PairOptions(search_size=239, negatives=0.0, augmentation=0.0)
CACHE = 10**8


def shade_of(pair: Pair) -> tuple[int, int, int]:
    """The colour in the middle of the template."""
    b, g, r = pair.template[63, 63].tolist()
    return (b, g, r)


def number_of(pair: Pair) -> int:
    """Which of the coloured targets of `scenes` the template shows."""
    return int(np.argmin([np.abs(np.array(colour(i)) - shade_of(pair)).sum() for i in range(12)]))


def equal(a: Pair, b: Pair) -> bool:
    same = np.array_equal(a.template, b.template) and np.array_equal(a.search, b.search)
    return same and a.corners == b.corners and a.present == b.present


# ---- the map of a crop


@pytest.mark.parametrize(
    ("box", "size", "scale"),
    [
        # A square of 31 has a context of sqrt(62 * 62); 62 px come to 127, corner centre to corner centre.
        ((10, 20, 31, 31), 127, 61 / 126),
        ((10, 20, 31, 31), 303, (62 * 303 / 127 - 1) / 302),
        # 10 x 40: p = 25, sqrt(35 * 65).
        ((0, 0, 10, 40), 127, (math.sqrt(35 * 65) - 1) / 126),
    ],
)
def test_without_jitter_the_context_fills_the_template(box, size: int, scale: float):
    to_frame = crop_map(np.array(box, dtype=float), size, Jitter())
    assert to_frame[:, :2] == pytest.approx(scale * np.eye(2))
    middle = to_frame @ [(size - 1) / 2, (size - 1) / 2, 1]
    assert middle == pytest.approx([box[0] + (box[2] - 1) / 2, box[1] + (box[3] - 1) / 2])


def test_without_jitter_it_is_the_crop_of_the_tracker(scenes: list[Sequence]):
    image = read_image(scenes[0].frames[0])
    fill = mean_colour(image)
    warped = warp(image, crop_map(np.array([60.0, 50, 31, 31]), 127, Jitter()), 127, fill)
    assert np.array_equal(warped, crop(image, 75, 65, 62, 127, fill))


@pytest.mark.parametrize(
    ("jitter", "expected"),
    [
        # A square of 63.5 has a context of 127 px, so that a pixel of the crop is one of the frame: 62.5 about 63.
        (Jitter(), (31.75, 31.75, 94.25, 94.25)),
        (Jitter(dx=5, dy=-3), (36.75, 28.75, 99.25, 91.25)),
        (Jitter(scale=0.5), (47.375, 47.375, 78.625, 78.625)),
        (Jitter(flip=-1, dx=5), (36.75, 31.75, 99.25, 94.25)),
        (Jitter(aspect=1.25), (63 - 31.25 * 1.25, 38, 63 + 31.25 * 1.25, 88)),
        (Jitter(angle=0.7), (31.75, 31.75, 94.25, 94.25)),
    ],
)
def test_jitter_says_where_the_target_comes_to_lie(jitter: Jitter, expected):
    box = np.array([10.0, 20.0, 63.5, 63.5])
    assert box_in_crop(box, crop_map(box, 127, jitter)) == pytest.approx(expected)


def test_a_quarter_turn_swaps_the_sides():
    box = np.array([10.0, 20.0, 21.0, 81.0])
    x0, y0, x1, y1 = box_in_crop(box, crop_map(box, 127, Jitter()))
    turned = box_in_crop(box, crop_map(box, 127, Jitter(angle=math.pi / 2)))
    assert turned == pytest.approx((y0, x0, y1, x1))


@given(
    st.tuples(st.floats(-500, 500), st.floats(-500, 500), st.floats(5, 400), st.floats(5, 400)),
    st.builds(
        Jitter,
        dx=st.floats(-60, 60),
        dy=st.floats(-60, 60),
        scale=st.floats(0.7, 1.4),
        flip=st.sampled_from([1.0, -1.0]),
        aspect=st.floats(0.85, 1.15),
    ),
)
def test_corners_lead_back_to_the_box(box, jitter: Jitter):
    to_frame = crop_map(np.array(box), 303, jitter)
    x0, y0, x1, y1 = box_in_crop(np.array(box), to_frame)
    assert x0 <= x1 and y0 <= y1
    corners = to_frame @ np.array([[x0, x1], [y0, y1], [1, 1]])
    x, y, w, h = box
    assert sorted(corners[0]) == pytest.approx([x, x + w - 1], abs=1e-6)
    assert sorted(corners[1]) == pytest.approx([y, y + h - 1], abs=1e-6)
    assert [(x0 + x1) / 2, (y0 + y1) / 2] == pytest.approx([151 + jitter.dx, 151 + jitter.dy], abs=1e-6)


# ---- pairs


def test_a_pair_depends_on_seed_and_number_alone(scenes: list[Sequence]):
    options = PairOptions(search_size=239, negatives=0.3)
    forwards = PairSampler(scenes, options, seed=3, cache_bytes=CACHE)
    backwards = PairSampler(scenes, options, seed=3)
    first = [forwards.pair(i) for i in range(12)]
    last = [backwards.pair(i) for i in reversed(range(12))][::-1]
    assert all(equal(a, b) for a, b in zip(first, last, strict=True))
    assert not any(equal(a, b) for a, b in itertools.pairwise(first))
    other = PairSampler(scenes, options, seed=4)
    assert not any(equal(pair, other.pair(i)) for i, pair in enumerate(first))


def test_forms(scenes: list[Sequence]):
    pair = PairSampler(scenes, PairOptions(search_size=239)).pair(0)
    assert (pair.template.shape, pair.search.shape) == ((127, 127, 3), (239, 239, 3))
    assert pair.template.dtype == pair.search.dtype == np.uint8


def test_the_target_really_lies_inside_the_corners(scenes: list[Sequence]):
    sampler = PairSampler(scenes, PLAIN, cache_bytes=CACHE)
    for i in range(60):
        pair = sampler.pair(i)
        rows, columns = np.nonzero(coloured(pair.search, colour(number_of(pair))))
        x0, y0, x1, y1 = pair.corners
        # A label ends at the centres of the last pixels, which reach half a pixel of the frame further.
        slack = 3.0
        assert columns.min() == pytest.approx(x0, abs=slack) and columns.max() == pytest.approx(x1, abs=slack)
        assert rows.min() == pytest.approx(y0, abs=slack) and rows.max() == pytest.approx(y1, abs=slack)


@pytest.mark.slow
def test_augmented_targets_lie_about_the_corners(scenes: list[Sequence]):
    """Under rotation, mirroring, blur and colour, the middle of what is saturated stays the middle of the corners."""
    sampler = PairSampler(scenes, dataclasses.replace(PLAIN, augmentation=1.0), cache_bytes=CACHE)
    errors = []
    for i in range(80):
        pair = sampler.pair(i)
        x0, y0, x1, y1 = np.array(pair.corners)
        y, x = np.mgrid[:239, :239]
        near = np.hypot(x - (x0 + x1) / 2, y - (y0 + y1) / 2) < max(x1 - x0, y1 - y0)
        weights = (np.ptp(pair.search.astype(float), axis=2) > 90) & near
        if weights.any():
            centre = (x[weights].mean(), y[weights].mean())
            errors.append(math.dist(centre, ((x0 + x1) / 2, (y0 + y1) / 2)))
    assert len(errors) > 50, "only some are grey"
    assert np.median(errors) < 1.5
    assert np.percentile(errors, 80) < 6, "some are covered"


def test_the_template_shows_the_target_in_its_middle(scenes: list[Sequence]):
    sampler = PairSampler(scenes, PLAIN, cache_bytes=CACHE)
    for i in range(20):
        pair = sampler.pair(i)
        rows, columns = np.nonzero(coloured(pair.template, colour(number_of(pair))))
        middle = [(columns.min() + columns.max()) / 2, (rows.min() + rows.max()) / 2]
        assert middle == pytest.approx([63, 63], abs=1.5)


def test_shift_and_scale_stay_in_their_limits(draw):
    box = (80.0, 60.0, 32.0, 32.0)
    sampler = PairSampler([draw([(box, colour(0))])], dataclasses.replace(PLAIN, shift=0.2, scale=0.3))
    corners = np.array([sampler.pair(i).corners for i in range(120)])
    middles = (corners[:, :2] + corners[:, 2:]) / 2 - 119
    assert np.abs(middles).max() <= 0.2 * 239 / 2
    assert (np.abs(middles).max(axis=0) > 0.16 * 239 / 2).all()
    plain = np.diff(np.array(box_in_crop(np.array(box), crop_map(np.array(box), 239, Jitter())))[[0, 2]])[0]
    factors = (corners[:, 2] - corners[:, 0]) / plain
    assert 1 / 1.3 - 1e-6 <= factors.min() < 0.82
    assert 1.22 < factors.max() <= 1.3 + 1e-6


def test_the_target_never_leaves_the_reach_of_the_cells(draw):
    """At 239 pixels cells end 32 px from the middle; a shift of 0.9 would go to 107."""
    sampler = PairSampler([draw([((80.0, 60.0, 32.0, 32.0), colour(0))])], dataclasses.replace(PLAIN, shift=0.9))
    corners = np.array([sampler.pair(i).corners for i in range(80)])
    assert np.abs((corners[:, :2] + corners[:, 2:]) / 2 - 119).max() <= 32 + 8


def test_the_two_frames_are_at_most_max_gap_apart(draw):
    box = (80.0, 60.0, 32.0, 32.0)
    clip = draw(*([(box, colour(i))] for i in range(10)))
    gaps = Counter()
    sampler = PairSampler([clip], dataclasses.replace(PLAIN, max_gap=2), cache_bytes=CACHE)
    for i in range(80):
        pair = sampler.pair(i)
        x, y = (round((pair.corners[k] + pair.corners[k + 2]) / 2) for k in (0, 1))
        seen = [
            int(np.argmin([np.abs(np.array(colour(j)) - p).sum() for j in range(10)]))
            for p in (shade_of(pair), pair.search[y, x].astype(int))
        ]
        gaps[seen[1] - seen[0]] += 1
    assert set(gaps) == {-2, -1, 0, 1, 2}


def test_clips_get_their_share(scenes: list[Sequence]):
    sampler = PairSampler(scenes, dataclasses.replace(PLAIN, clip_share=0.8), cache_bytes=CACHE)
    clips = sum(number_of(sampler.pair(i)) < 4 for i in range(200))
    assert clips / 200 == pytest.approx(0.8, abs=0.1)


def test_distractors_stand_beside_the_target_and_leave_it_alone(draw):
    """Large plain pictures, so that other colours come from distractors; those of the augmentation are off."""
    box = (280.0, 280.0, 32.0, 32.0)
    sampler = PairSampler([draw([(box, colour(i))], size=(600, 600)) for i in (0, 4)], PLAIN, cache_bytes=CACHE)
    rng = np.random.default_rng(0)
    shown = 0
    for i in range(40):
        pair = sampler.pair(i)
        target = sampler._kinds[0].draw(np.random.default_rng(i))
        search = sampler._with_distractor(pair.search, pair.corners, target, rng)
        x0, y0, x1, y1 = (round(v) for v in pair.corners)
        inner = slice(y0 + 6, y1 - 6), slice(x0 + 6, x1 - 6)
        assert np.array_equal(search[inner], pair.search[inner])
        away = search.copy()
        away[max(0, y0 - 8) : y1 + 8, max(0, x0 - 8) : x1 + 8] = 0
        shown += coloured(away, colour(0)).any() or coloured(away, colour(4)).any()
    assert 5 < shown < 35, "not in every crop: some would cover the target, or be the target itself"


@pytest.mark.slow
def test_some_targets_turn_far_and_none_without_augmentation(draw):
    """Of a bar four times as long as wide, the box of a turned one is wider."""
    clip = draw(*([((260.0, 220.0, 30.0, 120.0), colour(0))] for _ in range(2)), size=(600, 600))

    def shapes(options: PairOptions) -> list[float]:
        sampler = PairSampler([clip], options, cache_bytes=CACHE)
        corners = [sampler.pair(i).corners for i in range(150)]
        return [(x1 - x0) / (y1 - y0) for x0, y0, x1, y1 in corners]

    assert np.allclose(shapes(PLAIN), 29 / 119)
    turned = np.mean(np.array(shapes(dataclasses.replace(PLAIN, augmentation=1.0))) > 0.6)
    assert 0.01 < turned < 0.1


# ---- negative pairs


def test_the_share_of_negative_pairs(scenes: list[Sequence]):
    sampler = PairSampler(scenes, dataclasses.replace(PLAIN, negatives=0.3), cache_bytes=CACHE)
    absent = sum(not sampler.pair(i).present for i in range(250))
    assert absent / 250 == pytest.approx(0.3, abs=0.08)


@pytest.mark.slow
def test_negative_pairs_never_show_the_target(scenes: list[Sequence]):
    sampler = PairSampler(scenes, dataclasses.replace(PLAIN, negatives=1.0), cache_bytes=CACHE)
    absent = [pair for pair in map(sampler.pair, range(60)) if not pair.present]
    assert len(absent) > 50
    for pair in absent:
        assert not coloured(pair.search, colour(number_of(pair))).any()
        others = [coloured(pair.search, colour(i)).any() for i in range(10)]
        assert sum(others) == 1, "it shows another target"


@pytest.mark.slow
def test_a_negative_pair_may_look_at_a_neighbour_in_the_photograph(draw):
    left, right = ((20.0, 60.0, 30.0, 30.0), colour(0)), ((130.0, 60.0, 30.0, 30.0), colour(4))
    photo = draw([left, right])
    neighbour = dataclasses.replace(photo, name="other", boxes=np.array([right[0]]))
    sampler = PairSampler([photo, neighbour], dataclasses.replace(PLAIN, negatives=1.0), cache_bytes=CACHE)
    elsewhere = 0
    for i in range(60):
        pair = sampler.pair(i)
        assert pair.present, "the picture does hold it"
        target = coloured(pair.search, colour(number_of(pair)))
        x0, y0, x1, y1 = pair.corners
        if not 0 <= (x0 + x1) / 2 < 239:
            elsewhere += 1
            assert coloured(pair.search, colour(4 - number_of(pair))).any()
        rows, columns = np.nonzero(target)
        if len(rows):
            assert x0 - 3 <= columns.min() and columns.max() <= x1 + 3
            assert y0 - 3 <= rows.min() and rows.max() <= y1 + 3
    assert elsewhere / 60 == pytest.approx(0.7, abs=0.2)


def test_a_lone_picture_has_no_negative_pairs(draw):
    sampler = PairSampler([draw([((80.0, 60.0, 32.0, 32.0), colour(0))])], dataclasses.replace(PLAIN, negatives=1.0))
    for i in range(10):
        pair = sampler.pair(i)
        assert pair.present
        assert coloured(pair.search, colour(0)).any()


def test_sources_may_share_a_picture(draw):
    """A photograph is filed under its first object's source, and the other's has no picture of its own."""
    left, right = ((20.0, 60.0, 30.0, 30.0), colour(0)), ((130.0, 60.0, 30.0, 30.0), colour(4))
    photo = draw([left, right], source="cars")
    boat = dataclasses.replace(photo, name="boat", boxes=np.array([right[0]]), source="boats")
    away = draw([((80.0, 60.0, 30.0, 30.0), colour(8))], source="cars")
    sampler = PairSampler([photo, boat, away], dataclasses.replace(PLAIN, negatives=1.0), cache_bytes=CACHE)
    assert {number_of(sampler.pair(i)) for i in range(40)} == {0, 4, 8}


# ---- what is drawn


@pytest.mark.slow
def test_large_sources_count_by_the_square_root(tmp_path: Path):
    box = (8.0, 8.0, 16.0, 16.0)

    def photos(source: str, count: int, shade: int) -> list[Sequence]:
        paths = [paint(tmp_path / source / f"{k}.png", [(box, colour(shade))], (32, 32)) for k in range(count)]
        return [Sequence(f"{source}{k}", [path], np.array([box]), source) for k, path in enumerate(paths)]

    sampler = PairSampler(photos("large", 100, 0) + photos("small", 1, 6), PLAIN, cache_bytes=CACHE)
    drawn = Counter(number_of(sampler.pair(i)) for i in range(440))
    assert drawn[0] / drawn[6] == pytest.approx(10, rel=0.35)


def test_pictures_count_alike_however_many_objects_they_hold(draw):
    crowd = draw([((20.0, 60.0, 30.0, 30.0), colour(0))], source="s")
    objects = [dataclasses.replace(crowd, name=f"object{k}") for k in range(9)]
    alone = draw([((80.0, 60.0, 30.0, 30.0), colour(6))], source="s")
    sampler = PairSampler([*objects, alone], PLAIN, cache_bytes=CACHE)
    drawn = Counter(number_of(sampler.pair(i)) for i in range(150))
    assert drawn[6] / 150 == pytest.approx(0.5, abs=0.12)


@pytest.mark.parametrize(
    "box",
    [(np.nan,) * 4, (10, 10, np.nan, 20), (10, 10, 4.9, 5), (10, 10, 0, 50), (10, 10, -9, -9), (np.inf, 1, 20, 20)],
)
def test_useless_boxes_are_never_drawn(draw, tmp_path: Path, box):
    good = draw([((80.0, 60.0, 30.0, 30.0), colour(0))])
    gone = tmp_path / "gone.png"
    clip = Sequence("clip", [gone, good.frames[0], gone], np.array([box, good.boxes[0], box], dtype=float))
    photo = Sequence("photo", [gone], np.array([box], dtype=float))
    sampler = PairSampler([clip, photo], PLAIN)
    assert all(number_of(sampler.pair(i)) == 0 for i in range(20))
    with pytest.raises(UserError, match="no usable box"):
        PairSampler([photo], PLAIN)


def test_no_data_at_all():
    with pytest.raises(UserError, match="no usable box"):
        PairSampler([], PLAIN)


def test_a_missing_picture_is_named(tmp_path: Path):
    photo = Sequence("photo", [tmp_path / "gone.png"], np.array([[10.0, 10, 30, 30]]))
    with pytest.raises(UserError, match=r"gone\.png does not exist"):
        PairSampler([photo], PLAIN).pair(0)


# ---- the cache


@pytest.fixture
def three(tmp_path: Path) -> list[Path]:
    """Three pictures of 30 bytes."""
    return [paint(tmp_path / f"{name}.png", [((0, 0, 5, 2), colour(i))], (5, 2)) for i, name in enumerate("abc")]


def is_held(cache: ImageCache, path: Path) -> bool:
    """Whether the cache can do without the file."""
    aside = path.rename(path.with_suffix(".aside"))
    try:
        cache.get(path)
    except UserError:
        return False
    finally:
        aside.rename(path)
    return True


def test_cached_pictures_are_those_of_the_files(three: list[Path]):
    cache = ImageCache(1000, FrameStore(), mean_colour)
    for path in three * 2:
        image, fill = cache.get(path)
        assert np.array_equal(image, read_image(path))
        assert fill == mean_colour(image)


def test_the_cache_drops_what_was_unused_for_longest(three: list[Path]):
    a, b, c = three
    cache = ImageCache(60, FrameStore(), mean_colour)
    for path in (a, b, a, c):
        cache.get(path)
    assert [is_held(cache, path) for path in (a, b, c)] == [True, False, True]


@pytest.mark.parametrize(("limit", "held"), [(0, 0), (29, 0), (30, 1), (59, 1), (60, 2), (90, 3), (1000, 3)])
def test_the_cache_keeps_to_its_limit(three: list[Path], limit: int, held: int):
    cache = ImageCache(limit, FrameStore(), mean_colour)
    for path in three:
        assert np.array_equal(cache.get(path)[0], read_image(path))
    assert sum(is_held(cache, path) for path in three) == held


# ---- clips with several tracks


def test_a_negative_pair_of_a_clip_looks_at_another_track_of_the_same_frame(draw):
    places = [((20.0, 60.0, 30.0, 30.0), colour(0)), ((130.0, 60.0, 30.0, 30.0), colour(4))]
    one = draw(places, places, places, source="road")
    nothing = [np.nan] * 4
    two = dataclasses.replace(one, name="two", boxes=np.array([nothing, places[1][0], nothing]))
    far = draw([((80.0, 60.0, 30.0, 30.0), colour(8))] * 1, [((80.0, 60.0, 30.0, 30.0), colour(8))], source="road")
    options = dataclasses.replace(PLAIN, negatives=1.0, max_gap=0, shift=0.0)
    sampler = PairSampler([one, two, far], options, cache_bytes=CACHE)
    beside = 0
    for pair in (sampler.pair(i) for i in range(120)):
        if number_of(pair) == 4:
            middle = pair.search[119, 119].tolist()
            beside += pair.present
            assert coloured(np.array([[middle]]), colour(0)).any() == pair.present
    assert beside > 5


def test_pairs_of_a_video_are_those_of_its_frames(tmp_path: Path, draw):
    """The same boxes on frames of a video and on the same frames as images: the crops differ by compression alone."""
    target = (80.0, 60.0, 40.0, 40.0)
    images = draw(*[[(target, colour(0))]] * 4)
    writer = cv2.VideoWriter(str(tmp_path / "clip.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 25, (200, 160))
    for k in range(4):
        writer.write(images.frame(k))
    writer.release()
    video = dataclasses.replace(images, frames=video_frames(tmp_path / "clip.mp4"))
    store = FrameStore(tmp_path / "store")
    for i in range(6):
        a, b = PairSampler([images], PLAIN).pair(i), PairSampler([video], PLAIN, store=store).pair(i)
        assert a.corners == b.corners
        assert np.abs(a.search.astype(int) - b.search).mean() < 12


@pytest.mark.parametrize("name", ARCHITECTURES)
def test_pairs_of_every_architecture_are_drawn_alike_in_another_process(scenes: list[Sequence], name: str) -> None:
    arch = architecture(name)
    sampler = PairSampler(scenes, PairOptions(search_size=arch.search_size), seed=3, arch=arch)
    # what a loader process receives
    again = pickle.loads(pickle.dumps(sampler))
    assert equal(again.pair(5), sampler.pair(5))

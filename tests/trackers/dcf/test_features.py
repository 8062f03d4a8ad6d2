"""fHOG against a plain one, colour names, grey cells."""

import sys

import numpy as np
import pytest

pytest.importorskip("scipy")
pytest.importorskip("numba")

from psiamfcpp.trackers.dcf import features, kernels

RNG = np.random.default_rng(3)


def plain_fhog(image, cell):
    """The feature step by step, in double precision; channels in the order of their rank on a tie."""
    image = np.atleast_3d(image).astype(float)
    gy, gx = np.gradient(image, axis=(0, 1))
    square = gx**2 + gy**2
    first = square.argmax(axis=2)[..., None]
    gx, gy, square = (np.take_along_axis(a, first, 2)[..., 0] for a in (gx, gy, square))
    size = np.maximum(np.sqrt(square), 1e-10)
    cosine = np.where(gy < 0, -gx, gx) / size
    angle = np.arccos(np.clip(np.trunc(cosine * 1e4 + 1e-9 * np.sign(cosine)) / 1e4, -1, 1)) + np.pi * (gy < 0)
    bins = np.floor(9 * angle / np.pi + 0.5).astype(int) % 18
    rows, columns = image.shape[0] // cell, image.shape[1] // cell
    votes = np.zeros((18, rows, columns))
    for y in range(rows * cell):
        for x in range(columns * cell):
            at = (y + 0.5) / cell - 0.5, (x + 0.5) / cell - 0.5
            for i in range(rows):
                for j in range(columns):
                    share = max(0, 1 - abs(at[0] - i)) * max(0, 1 - abs(at[1] - j))
                    votes[bins[y, x], i, j] += share * size[y, x] / cell**2
    for edge in (votes[:, 0], votes[:, -1], votes[:, :, 0], votes[:, :, -1]):
        edge *= 8 / 7
    both = votes[:9] + votes[9:]
    energy = np.pad((both**2).sum(axis=0), 1, mode="edge")
    # corners on the border are those of the nearest inner corner
    corner = energy[1:-2, 1:-2] + energy[2:-1, 1:-2] + energy[1:-2, 2:-1] + energy[2:-1, 2:-1]
    norms = np.pad(1 / np.sqrt(corner + 1e-4 / (4 * cell**4)), 1, mode="edge")
    out = np.zeros((31, rows, columns))
    for k, n in enumerate((norms[1:, 1:], norms[:-1, 1:], norms[1:, :-1], norms[:-1, :-1])):
        signed, unsigned = np.minimum(votes * n, 0.2), np.minimum(both * n, 0.2)
        out[:18] += signed / 2
        out[18:27] += unsigned / 2
        out[27 + k] = 0.2357 * signed.sum(axis=0)
    return out


@pytest.mark.parametrize(
    ("shape", "cell"),
    [((16, 20, 3), 4), ((19, 23, 3), 4), ((24, 31, 1), 6), ((9, 12, 3), 3), ((8, 8), 4), ((6, 7, 3), 2)],
)
def test_fhog_equals_the_plain_one(shape, cell):
    image = RNG.normal(size=shape).astype(np.float32) * 40 + 128
    # frames are BGR, the plain one ranks channels as they come: no tie in random numbers
    assert np.abs(features.fhog(image, cell) - plain_fhog(image, cell)).max() < 2e-4


def test_fhog_equals_the_authors_vectors(shared_data):
    if not (shared_data.parent / "dcf" / "vectors.py").is_file():
        pytest.skip("no reference vectors beside the research data")
    sys.path.insert(0, str(shared_data.parent / "dcf"))
    try:
        import vectors
    finally:
        sys.path.pop(0)

    def fhog(image, cell):
        return features.fhog(image[..., ::-1] if image.ndim == 3 else image, cell).transpose(1, 2, 0)

    assert max(vectors.check(fhog).values()) < 1e-4


def test_the_processors_roots_change_fhog_little():
    image = RNG.integers(0, 256, (40, 40, 3), dtype=np.uint8)
    exact, approximate = features.fhog(image), features.fhog(image, sse=True)
    assert 0 < np.abs(exact - approximate).mean() < 1e-3


@pytest.mark.parametrize(("step", "inverse"), [(0, 0.999755859375), (1024, 0.7069091796875)])
def test_inverse_roots_of_one_and_two_are_those_of_the_authors_processor(step, inverse):
    assert kernels.ROOTS[0, step] == inverse


def test_roots_are_within_the_documented_error():
    middle = 1 + (np.arange(1024) + 0.5) / 1024
    exact = np.sqrt(np.concatenate([middle, 2 * middle]))
    assert np.abs(kernels.ROOTS[0] * exact - 1).max() < 1.5 / 4096
    assert np.abs(kernels.ROOTS[1] / exact - 1).max() < 3 / 4096


def test_patches_of_one_size_give_what_each_gives():
    patches = RNG.integers(0, 256, (3, 17, 22, 3), dtype=np.uint8)
    assert np.array_equal(features.fhog_many(patches), np.stack([features.fhog(p) for p in patches]))


@pytest.mark.parametrize("shape", [(3, 20, 3), (20, 2, 3)])
def test_a_patch_without_a_cell_has_no_feature(shape):
    assert features.fhog(np.zeros(shape, np.uint8)).size == 0


def test_grey_is_matlabs():
    patch = RNG.integers(0, 256, (30, 30, 3), dtype=np.uint8)
    exact = patch @ np.array([0.114021, 0.587043, 0.298936])
    assert np.array_equal(features.grey(patch), np.floor(exact + 0.5))


def test_grey_cells_are_means_of_unrounded_grey():
    patch = RNG.integers(0, 256, (10, 13, 3), dtype=np.uint8)
    exact = (patch @ np.array([0.114021, 0.587043, 0.298936]))[:8, :12] / 255 - 0.5
    assert np.allclose(features.grey_cells(patch), exact.reshape(2, 4, 3, 4).mean(axis=(1, 3)), atol=1e-6)


def test_colour_names_are_means_of_the_tables_rows():
    patch = RNG.integers(0, 256, (9, 13, 3), dtype=np.uint8)
    b, g, r = np.moveaxis(patch[:8, :12].astype(int) // 8, -1, 0)
    rows = features.colour_name_table()[r + 32 * g + 1024 * b]
    want = rows.reshape(2, 4, 3, 4, 10).mean(axis=(1, 3)).transpose(2, 0, 1)
    assert np.allclose(features.colour_names(patch), want, atol=1e-6)


def test_the_first_colour_has_the_published_names():
    want = (0.4597, 0.0148, 0.0443, -0.0282, 0.0012, -0.0050, 0.3452, 0.0184, 0.2399, 0.1689)
    assert np.allclose(features.colour_name_table()[0], want, atol=6e-5)


@pytest.mark.parametrize(("colour", "channels"), [(True, 42), (False, 32)])
def test_the_joint_feature_holds_grey_fhog_and_names_in_this_order(colour, channels):
    patch = RNG.integers(0, 256, (20, 24, 3), dtype=np.uint8)
    joint = features.grey_hog_names(patch, colour=colour)
    assert joint.shape == (channels, 5, 6)
    assert np.array_equal(joint[0], features.grey_cells(patch))
    assert np.array_equal(joint[1:32], features.fhog(patch, sse=True))
    if colour:
        assert np.array_equal(joint[32:], features.colour_names(patch))


def test_normalised_energy_is_that_of_ones():
    block = RNG.normal(size=(2, 3, 4, 5)).astype(np.float32)
    assert np.allclose(np.square(features.normalise_energy(block)).sum(axis=(1, 2, 3)), 3 * 4 * 5, rtol=1e-5)
    assert not features.normalise_energy(np.zeros_like(block)).any()

import numpy as np
import pytest
from particle_scene import camera, field, seen, turn_z
from scipy.special import ellipeinc, ellipkinc

from weather_aug.particles import statistics, tumble

ROWS, COLUMNS = np.array([0, 0, 0, 1, 1, 2]), np.array([0, 1, 2, 1, 2, 2])


def matrices(six):
    """Symmetric matrices (..., 3, 3) of (xx, xy, xz, yy, yz, zz)."""
    full = np.empty((*six.shape[:-1], 3, 3))
    full[..., ROWS, COLUMNS] = full[..., COLUMNS, ROWS] = six
    return full


def covariances(phase):
    """(SHAPES, 3, 3) at a phase of the tumbling."""
    table = tumble.tumbling()[0]
    harmonics = [1, np.cos(phase), np.sin(phase), np.cos(2 * phase), np.sin(2 * phase)]
    return matrices(np.tensordot(harmonics, table, axes=(0, 1)))


def directions(count):
    """Unit vectors spread evenly over the sphere (Fibonacci's lattice)."""
    k = np.arange(count) + 0.5
    cosine, azimuth = 1 - 2 * k / count, np.pi * (1 + 5**0.5) * k
    sine = np.sqrt(1 - cosine**2)
    return np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine], axis=1)


def silhouettes(covariance, towards):
    """2 pi sqrt(det) of the covariance projected along each direction, (N, M)."""
    first = np.cross(towards, (0.3, 0.5, 0.8))
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(towards, first)
    a = np.einsum("mi,nij,mj->nm", first, covariance, first)
    b = np.einsum("mi,nij,mj->nm", first, covariance, second)
    c = np.einsum("mi,nij,mj->nm", second, covariance, second)
    return 2 * np.pi * np.sqrt(a * c - b * b)


def ellipsoid_surface(axes):
    """Surface of an ellipsoid of full axes a >= b >= c, by elliptic integrals (Legendre)."""
    a, b, c = np.sort(axes / 2)[::-1]
    phi = np.arccos(c / a)
    k2 = a**2 * (b**2 - c**2) / (b**2 * (a**2 - c**2))
    parts = ellipeinc(phi, k2) * np.sin(phi) ** 2 + ellipkinc(phi, k2) * np.cos(phi) ** 2
    return 2 * np.pi * c**2 + 2 * np.pi * a * b / np.sin(phi) * parts


def test_mean_silhouette_is_a_quarter_of_the_surface():
    """Cauchy's theorem against Legendre's closed form."""
    axes = np.array([[1.0, 0.8, 0.5], [1.0, 0.99, 0.4], [1.0, 0.6, 0.55]])
    expected = [ellipsoid_surface(row) / 4 for row in axes]
    np.testing.assert_allclose(tumble.mean_silhouette(axes), expected, rtol=1e-5)


def mean_area_error(covariance):
    area = silhouettes(covariance, directions(400)).mean(axis=1)
    return np.abs(area / (np.pi / 4) - 1).max()


def test_a_flake_covers_the_disc_of_its_diameter_on_average():
    """Each shape, averaged over all directions, within 1 %: extinction does not know of shapes."""
    assert mean_area_error(covariances(0.7)) < 0.01


def test_without_normalisation_the_area_is_wrong(monkeypatch):
    """Planted fault: flakes of axes (1, b, c) D cover too little."""
    monkeypatch.setattr(tumble, "mean_silhouette", lambda axes: np.full(len(axes), np.pi / 4))
    table = tumble.tumbling.__wrapped__()[0]
    assert mean_area_error(matrices(table[:, 0] + table[:, 1] + table[:, 3])) > 0.1


def test_one_silhouette_is_the_ellipse_of_its_ellipsoid():
    """Along an axis of the ellipsoid the shadow is pi/4 times the two others."""
    covariance = covariances(0.0)[:20]
    values, vectors = np.linalg.eigh(covariance)
    for k in range(20):
        axes = np.sqrt(8 * values[k])
        for n in range(3):
            area = silhouettes(covariance[k : k + 1], vectors[k][:, n][None])[0, 0]
            assert area == pytest.approx(np.pi / 4 * np.delete(axes, n).prod())


def test_shapes_are_drawn_from_their_ranges():
    axes = np.sqrt(8 * np.linalg.eigvalsh(covariances(0.0)))
    middle, short = axes[:, 1] / axes[:, 2], axes[:, 0] / axes[:, 2]
    assert 0.4 <= short.min() < 0.43 and 0.95 < middle.max() <= 1.0
    # Means of the larger and the smaller of U(0.6, 1) and U(0.4, 0.8).
    assert (middle + short).mean() == pytest.approx(1.4, abs=0.04)


def test_tumbling_turns_an_ellipsoid_and_keeps_its_shape():
    """Eigenvalues stay; attitudes go once round and come back; mean rate is 0, spread 0.5 Hz."""
    start = np.linalg.eigvalsh(covariances(0.0))
    for phase in (0.4, 2.0, 5.0):
        np.testing.assert_allclose(np.linalg.eigvalsh(covariances(phase)), start, rtol=1e-9)
        assert np.abs(covariances(phase) - covariances(0.0)).max() > 0.01
    np.testing.assert_allclose(covariances(2 * np.pi), covariances(0.0), atol=1e-12)
    rates_hz = tumble.tumbling()[1]
    assert abs(rates_hz.mean()) < 0.1
    assert rates_hz.std() == pytest.approx(0.5, rel=0.15)


def test_orientations_are_isotropic():
    """The mean covariance is a multiple of one: no direction is favoured."""
    mean = covariances(1.0).mean(axis=0)
    np.testing.assert_allclose(mean / np.trace(mean) * 3, np.eye(3), atol=0.06)


def test_shapes_in_camera_axes_are_turned():
    rotation = turn_z(30) @ np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    turned = matrices(tumble.shapes_in(rotation))
    expected = rotation.T @ matrices(tumble.tumbling()[0]) @ rotation
    np.testing.assert_allclose(turned, expected, atol=1e-7)


def test_flakes_of_the_field_are_ellipsoids_and_drops_are_balls():
    cam = camera()
    for population in (statistics.snow(2.0), statistics.rain(20.0)):
        resolved = field(population).resolve(cam, 20_000)
        found = seen(population, cam, 1.0, resolved)
        values = np.linalg.eigvalsh(matrices(found[:, 6:12].astype(float)))
        assert values.min() > 0
        if population.tumbles:
            assert np.median(values[:, 0] / values[:, 2]) < 0.6
            sizes = np.sqrt(8 * np.linalg.det(matrices(found[:, 6:12].astype(float))) ** (1 / 3))
        else:
            np.testing.assert_allclose(values[:, 0], values[:, 2], rtol=1e-6)
            sizes = np.sqrt(8 * values[:, 0])
        # Of equal mean shadow a ball has the largest volume, by a few per cent in size here.
        assert 0.9 * population.diameters_m.min() < sizes.min()
        assert sizes.max() <= population.diameters_m.max() * 1.00001


def test_the_mean_silhouette_of_drawn_flakes_is_the_disc_of_their_class():
    """Over many flakes seen from one camera, at two times; the extinction counts on it."""
    population, cam = statistics.snow(2.0), camera(width=400, height=300)
    resolved = field(population).resolve(cam, 40_000)
    for time_s in (0.0, 33.3):
        found = seen(population, cam, time_s, resolved).astype(float)
        # Many attitudes from one direction are one attitude from many directions.
        covariance = matrices(found[:, 6:12])
        shadow = silhouettes(covariance, np.array([[0.0, 0, 1]]))[:, 0]
        relative = shadow / (np.pi / 4 * volume_share(covariance))
        assert relative.std() > 0.05
        assert relative.mean() == pytest.approx(
            (1 / volume_share(covariances(0.0))).mean(), rel=0.01
        )


def volume_share(covariance):
    """Product of the axes to the power 2/3: an area that does not depend on the attitude."""
    return (512 * np.linalg.det(covariance)) ** (1 / 3)

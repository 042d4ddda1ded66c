"""Meshes against the volumes and outlines of the solids they stand for."""

import numpy as np
import pytest

from apex_bat.simulation.meshes import (
    SAGITTA_M,
    Triangles,
    box_mesh,
    capsule_mesh,
    cylinder_mesh,
    num_sides,
    place_mesh,
    sphere_mesh,
)


def volume_m3(mesh: Triangles) -> float:
    """Sum of the tetrahedra over the faces of a convex solid that holds the origin."""
    return float(np.abs(np.linalg.det(mesh)).sum() / 6.0)


def test_meshes_enclose_the_volumes_of_their_solids() -> None:
    assert volume_m3(box_mesh(2.0, 3.0, 0.5)) == pytest.approx(3.0)
    assert volume_m3(cylinder_mesh(0.6, 1.5)) == pytest.approx(np.pi * 0.36 * 1.5, rel=1e-3)
    assert volume_m3(sphere_mesh(0.3)) == pytest.approx(4 / 3 * np.pi * 0.027, rel=5e-3)
    assert volume_m3(capsule_mesh(0.2, 1.0)) == pytest.approx(np.pi * 0.04 + 4 / 3 * np.pi * 0.008, rel=5e-3)


@pytest.mark.parametrize("radius_m", [0.05, 0.5, 1.07312, 3.0])
def test_sides_of_round_meshes_lie_within_the_stated_tolerance(radius_m: float) -> None:
    assert radius_m * (1.0 - np.cos(np.pi / num_sides(radius_m))) <= SAGITTA_M
    assert np.hypot(*cylinder_mesh(radius_m, 1.0)[:, :, :2].reshape(-1, 2).T).max() == pytest.approx(radius_m)


def test_every_edge_of_a_mesh_is_shared_by_two_faces() -> None:
    for mesh in (box_mesh(1.0, 2.0, 3.0), cylinder_mesh(0.5, 1.0), sphere_mesh(0.5)):
        corners = np.round(mesh, 9) + 0.0
        edges = [frozenset((tuple(face[k]), tuple(face[(k + 1) % 3]))) for face in corners.tolist() for k in range(3)]
        assert set(np.unique(np.unique([hash(edge) for edge in edges], return_counts=True)[1])) == {2}


def test_placing_turns_first_and_moves_then() -> None:
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    placed = place_mesh(np.array([[[1.0, 0.0, 0.0]] * 3]), np.array([5.0, 0.0, 1.0]), quarter)
    np.testing.assert_allclose(placed[0, 0], [5.0, 1.0, 1.0])

"""Rotations against scipy.spatial.transform, an independent implementation of the same (scalar-last) convention."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from crazyem.physics import rotations

vectors = st.lists(st.floats(-10, 10), min_size=3, max_size=3).map(np.array)
tiny_or_not = st.builds(lambda v, s: v * s, vectors, st.sampled_from([0.0, 1e-300, 1e-12, 1e-6, 1e-3, 0.1, 1.0]))
attitudes = st.integers(0, 2**32 - 1).map(lambda seed: Rotation.random(random_state=seed))


@given(vectors, vectors)
def test_skew_is_the_cross_product(a, b):
    np.testing.assert_allclose(rotations.skew(a) @ b, np.cross(a, b), atol=1e-13)


@given(attitudes, attitudes)
def test_product_and_conjugate(a, b):
    ours = rotations.quaternion_product(a.as_quat(), b.as_quat())
    same_up_to_sign(ours, (a * b).as_quat())
    same_up_to_sign(rotations.quaternion_conjugate(a.as_quat()), a.inv().as_quat())


@given(attitudes)
def test_matrix(a):
    np.testing.assert_allclose(rotations.rotation_matrix(a.as_quat()), a.as_matrix(), atol=1e-14)


@given(tiny_or_not)
def test_exponential(phi):
    ours = rotations.quaternion_from_rotation_vector(phi)
    same_up_to_sign(ours, Rotation.from_rotvec(phi).as_quat())
    np.testing.assert_allclose(np.linalg.norm(ours), 1.0, rtol=1e-14)


@given(attitudes, st.sampled_from([1.0, -1.0]))
def test_logarithm_takes_the_shorter_way(a, sign):
    ours = rotations.rotation_vector_from_quaternion(sign * a.as_quat())
    assert np.linalg.norm(ours) <= np.pi + 1e-12
    np.testing.assert_allclose(Rotation.from_rotvec(ours).as_matrix(), a.as_matrix(), atol=1e-12)


@given(tiny_or_not)
def test_logarithm_inverts_the_exponential(phi):
    if np.linalg.norm(phi) < 3.1:
        back = rotations.rotation_vector_from_quaternion(rotations.quaternion_from_rotation_vector(phi))
        np.testing.assert_allclose(back, phi, rtol=1e-9, atol=1e-12)


@given(st.floats(-3, 3), st.floats(-1.5, 1.5), st.floats(-3, 3))
def test_euler_angles(roll, pitch, yaw):
    expected = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_quat()
    same_up_to_sign(rotations.quaternion_from_euler(roll, pitch, yaw), expected)


def test_arrays_of_rotations_are_taken_elementwise():
    many = Rotation.random(7, random_state=1)
    q = many.as_quat().reshape(7, 1, 4)
    np.testing.assert_allclose(rotations.rotation_matrix(q)[:, 0], many.as_matrix(), atol=1e-14)
    phi = rotations.rotation_vector_from_quaternion(q)
    np.testing.assert_allclose(phi[:, 0], many.as_rotvec(), atol=1e-12)
    np.testing.assert_allclose(np.abs(np.sum(rotations.quaternion_from_rotation_vector(phi) * q, -1)), 1.0, rtol=1e-12)
    unity = rotations.quaternion_product(q, rotations.quaternion_conjugate(q))
    np.testing.assert_allclose(unity[:, 0], np.tile([0.0, 0.0, 0.0, 1.0], (7, 1)), atol=1e-15)


def same_up_to_sign(a, b):
    """q and -q are the same rotation."""
    np.testing.assert_allclose(a * np.sign(np.dot(a, b)), b, atol=1e-14)

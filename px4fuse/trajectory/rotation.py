"""Operations on quaternions (w, x, y, z), shape (..., 4), with the Hamilton product."""

import numpy as np

from px4fuse.core.arrays import Array, interpolate_columns

# Cross-product matrices of the three unit vectors, one in each row
FLATTENED_CROSS_PRODUCT_MATRICES = np.cross(np.eye(3), np.eye(3)[:, None]).reshape(3, 9)


def multiply(a: Array, b: Array) -> Array:
    """Compute the product a ⊗ b of quaternions: rotation by b, then by a."""
    w, x, y, z = _split_components(a)
    s, i, j, k = _split_components(b)
    product = np.empty(np.broadcast_shapes(a.shape, b.shape))
    product[..., 0] = w * s - x * i - y * j - z * k
    product[..., 1] = w * i + x * s + y * k - z * j
    product[..., 2] = w * j - x * k + y * s + z * i
    product[..., 3] = w * k + x * j - y * i + z * s
    return product


def _split_components(vectors: Array) -> list[Array]:
    """Split vectors into components, faster than np.moveaxis for few vectors."""
    return [vectors[..., index] for index in range(vectors.shape[-1])]


def conjugate(q: Array) -> Array:
    """Return the conjugates of quaternions (inverse rotations)."""
    return np.asarray(q * np.array([1.0, -1.0, -1.0, -1.0]))


def from_rotation_vector(rotation: Array) -> Array:
    """Convert rotation vectors (rad) to quaternions (w, x, y, z)."""
    angle = np.linalg.norm(rotation, axis=-1, keepdims=True)
    # sinc(a / 2π) = sin(a / 2) / (a / 2), also for a = 0
    return np.concatenate([np.cos(angle / 2), 0.5 * np.sinc(angle / (2 * np.pi)) * rotation], -1)


def to_rotation_vector(q: Array) -> Array:
    """Convert quaternions to rotation vectors (rad) of at most π."""
    q = q * np.where(q[..., :1] < 0.0, -1.0, 1.0)
    imaginary_norm = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(imaginary_norm, q[..., :1])
    return q[..., 1:] * np.where(
        imaginary_norm > 1e-12, angle / np.maximum(imaginary_norm, 1e-12), 2.0
    )


def build_matrix(*rows: tuple[Array | float, ...]) -> Array:
    """Build matrices from their elements, row by row."""
    shape = np.broadcast_shapes(*(np.shape(element) for row in rows for element in row))
    matrices = np.empty((*shape, len(rows), len(rows[0])))
    for i, row in enumerate(rows):
        for j, element in enumerate(row):
            matrices[..., i, j] = element
    return matrices


def to_rotation_matrix(q: Array) -> Array:
    """Convert quaternions to rotation matrices, shape (..., 3, 3)."""
    w, x, y, z = _split_components(q)
    return build_matrix(
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


def rotate(matrices: Array, vectors: Array) -> Array:
    """Multiply n matrices with n vectors, one by one, shape (n, 3)."""
    # np.einsum is slow for arrays of different types
    return np.asarray(np.einsum("nij,nj->ni", np.asarray(matrices, dtype=np.float64), vectors))


def skew(v: Array) -> Array:
    """Return the cross-product matrices [v]× with [v]× u = v × u, shape (..., 3, 3)."""
    return (v @ FLATTENED_CROSS_PRODUCT_MATRICES).reshape(*v.shape, 3)


def cumulative_product(quaternions: Array) -> Array:
    """Compute the products q_0, q_0 ⊗ q_1, q_0 ⊗ q_1 ⊗ q_2, ... of quaternions, shape (n, 4)."""
    if len(quaternions) < 2:
        return quaternions
    # Recursion with half as many quaternions: the products of the pairs (q_0, q_1), (q_2, q_3), ...
    # A last quaternion without a partner is in no pair
    product = np.empty_like(quaternions)
    product[0] = quaternions[0]
    # Products up to q_1, q_3, ...: the cumulative products of the pairs
    product[1::2] = cumulative_product(multiply(quaternions[:-1:2], quaternions[1::2]))
    # Cumulative products at even indices: previous product, multiplied by the quaternion
    product[2::2] = multiply(product[1:-1:2], quaternions[2::2])
    return np.asarray(product / np.linalg.norm(product, axis=1, keepdims=True))


def interpolate(times: Array, known_times: Array, quaternions: Array) -> Array:
    """Interpolate quaternions linearly and normalise them, for small angles between them."""
    is_sign_changed = np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0.0
    continuity_signs = np.append(1.0, np.cumprod(np.where(is_sign_changed, -1.0, 1.0)))
    q = interpolate_columns(times, known_times, quaternions * continuity_signs[:, None])
    return np.asarray(q / np.linalg.norm(q, axis=-1, keepdims=True))


def heading(q: Array) -> Array:
    """Return the headings (rad, clockwise from above, unwrapped) of quaternions in NED."""
    w, x, y, z = _split_components(q)
    return np.unwrap(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))

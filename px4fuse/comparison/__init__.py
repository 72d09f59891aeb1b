"""Our filter against EKF2 and ground truth."""

from px4fuse.plain import sentences

say = sentences(__file__)

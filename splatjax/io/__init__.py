

from ._atomic import atomic_path as atomic_path

"""How trimesh is called: whatever it raises or warns of is one ``ValueError`` with a remedy."""

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from meshkit.io._lines import COPY_AGAIN


@contextmanager
def trimesh_reads(remedy: str = COPY_AGAIN) -> Iterator[None]:
    """Around a call of trimesh; what it logs is of normals and textures, which are not read."""
    log, silence = logging.getLogger("trimesh"), logging.NullHandler()
    log.addHandler(silence)
    try:
        with warnings.catch_warnings(record=True) as caught, np.errstate(over="ignore"):  # infinity is reported later
            warnings.simplefilter("always")
            warnings.simplefilter("ignore", DeprecationWarning)  # of code, not of this file, but for the next one
            warnings.filterwarnings("always", "string or file could not be read")
            yield
        if caught:
            raise ValueError(caught[0].message)
    except Exception as error:  # trimesh raises what its readers raise
        raise ValueError(f"damaged: {type(error).__name__} of trimesh, {error}; {remedy}") from error
    finally:
        log.removeHandler(silence)

"""What is known of how strong the lights of a picture were."""

import abc

import equinox as eqx
import numpy as np


class AbstractIntensity(eqx.Module):
    """Factors on all light of a picture: which channels share one that is to be found."""

    @abc.abstractmethod
    def groups(self, channels: int) -> np.ndarray:
        """Give, for each channel, the number of its factor among those of the picture; -1 where it
        is known to be 1.
        """


class KnownIntensity(AbstractIntensity):
    """The lights are as strong as they say."""

    def groups(self, channels: int) -> np.ndarray:
        return np.full(channels, -1)


class UnknownIntensity(AbstractIntensity):
    """One factor for all channels: an exposure that was not measured, under light of a known
    color.
    """

    def groups(self, channels: int) -> np.ndarray:
        return np.zeros(channels, int)


class UnknownColor(AbstractIntensity):
    """A factor for each channel. What then tells of the material is how the light is spread over
    the picture alone.
    """

    def groups(self, channels: int) -> np.ndarray:
        return np.arange(channels)

"""Building blocks of pose-transfer networks."""

from meshkit.nn.resblock import ConditionalResBlock
from meshkit.nn.setconv import SetConv, SetConvExtractor
from meshkit.nn.spectral import settle_spectral_norm

__all__ = ["ConditionalResBlock", "SetConv", "SetConvExtractor", "settle_spectral_norm"]

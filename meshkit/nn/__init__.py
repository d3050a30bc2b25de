"""Building blocks of pose-transfer networks."""

from meshkit.nn.resblock import ConditionalResBlock
from meshkit.nn.setconv import SetConv, SetConvExtractor

__all__ = ["ConditionalResBlock", "SetConv", "SetConvExtractor"]

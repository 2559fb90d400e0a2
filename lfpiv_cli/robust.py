"""Constants by which medians and percentiles stand for what a few strays would spoil: deviations, brightness."""

# Of a normal distribution: the standard deviation over the median of |x|, and that median in standard deviations.
MAD_TO_SIGMA = 1.4826
HALF_NORMAL_MEDIAN = 0.6745
# Bright pixels are as bright as this percentile of all; single ones may be brighter for any reason.
BRIGHTEST_PERCENTILE = 99.9
# A pixel counts as lit above this share of the image's bright ones.
LIT_SHARE = 0.02

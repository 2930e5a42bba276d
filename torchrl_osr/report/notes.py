"""What the report says about how to read its tables and figures."""

FEW_SEEDS = (
    "A bootstrap over three seeds spans about the lowest to the highest of them, and "
    "holds the true mean in three cases of four rather than in 95 of 100; over ten, in "
    "nine of ten."
)

EPISODES_MARK = (
    "ᵉ: one seed, or one on some data set, so the interval is over the episodes of "
    "these trainings and says nothing about another."
)
VERSIONS_MARK = "†: runs of different versions, or some do not say theirs."

TABLE_NOTE = (
    "Normalised score, and below it the decrease in percent of the clean score [95 % "
    "intervals: seeds are resampled, then episodes, clean and disturbed in pairs]. A "
    f"negative decrease is a gain. {EPISODES_MARK}"
)

STRENGTH_NOTE = (
    "Score as a share of the same policies' clean score, with the intervals of the "
    "tables above. Strengths stand at equal distances."
)

RECOVERY_NOTE = (
    "Upper panels: mean distance to the nearest data in units of the data's own 95 % "
    "quantile, of the episodes that still last: whoever falls leaves the mean, so read "
    "it with the share below. Lower panels: of the episodes that the disturbance came "
    "to, the share that has been back within the quantile; who fell, or whose time was "
    "over, counts as not recovered. Step 0: the disturbance acts for the last time. "
    "Bands: 95 %, over seeds; below, over seeds and episodes."
)

"""Tools beside the stages: audits of classifiers, runs side by side, exports for other software."""

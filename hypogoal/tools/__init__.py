"""Tools beside the stages: audits of classifiers, comparisons of runs, imports and exports."""

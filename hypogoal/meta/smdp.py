"""Returns and advantages of decisions that last several steps."""

import numpy as np

from hypogoal.core.arrays import Bools, Doubles


def smdp_advantages(
    returns: Doubles,
    discounts: Doubles,
    values: Doubles,
    next_values: Doubles,
    terminated: Bools,
    ended: Bools,
    trace: float,
) -> Doubles:
    """Return the generalised advantages of consecutive decisions of one environment.

    delta_t = R_t + gamma^tau_t (1 - terminated_t) V(s'_t) - V(s_t);
    A_t = delta_t + gamma^tau_t lambda (1 - ended_t) A_{t+1}.

    Args:
        returns: R_t, float64 (T,), the rewards inside the option, discounted from the option's start.
        discounts: gamma ** tau_t, float64 (T,).
        values: V(s_t), float64 (T,).
        next_values: V(s'_t) of the state reached, float64 (T,).
        terminated: bool (T,), whether nothing follows the state reached.
        ended: bool (T,), whether the episode ended in the state reached, for whatever reason.
        trace: lambda.

    Returns:
        A_t, float64 (T,).

    Source: Schulman et al. 2016 (GAE) with the SMDP discount of Sutton, Precup and Singh 1999.
    """
    advantages = np.zeros(len(returns))
    following = 0.0
    for t in reversed(range(len(returns))):
        delta = returns[t] + discounts[t] * (not terminated[t]) * next_values[t] - values[t]
        following = delta + discounts[t] * trace * (not ended[t]) * following
        advantages[t] = following
    return advantages


def scaled_advantages(advantages: Doubles, floor: float) -> Doubles:
    """Return advantages (n,) less their mean, divided by their standard deviation or by ``floor``, whichever is larger.

    Without a floor the noise of a batch without rewards would be blown up to the size of a signal, and the policy would
    drift until it is sure of something arbitrary.
    """
    return (advantages - advantages.mean()) / max(
        float(advantages.std()),
        floor,
        1e-8,
    )


def explained_variance(values: Doubles, returns: Doubles) -> float:
    """Return the share of the variance of returns (n,) that their predictions ``values`` (n,) explain.

    The share is 0 if the returns do not vary.
    """
    variance = float(returns.var())
    return 1 - float((returns - values).var()) / variance if variance > 0 else 0.0

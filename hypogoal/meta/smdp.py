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
    """Generalised advantages of consecutive decisions of one environment.

    delta_t = R_t + gamma^tau_t (1 - terminated_t) V(s'_t) - V(s_t);
    A_t = delta_t + gamma^tau_t lambda (1 - ended_t) A_{t+1}.

    Args:
        returns: R_t, rewards inside the option, discounted from its start, (T,).
        discounts: gamma ** tau_t, (T,).
        values: V(s_t), (T,).
        next_values: V of the state reached, (T,).
        terminated: nothing follows the state reached, (T,).
        ended: the episode ended there, for whatever reason, (T,).
        trace: lambda.

    Returns:
        A_t, (T,).

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
    """Advantages (n,) less their mean, in units of their standard deviation, or of ``floor`` where that is larger.

    Without a floor the noise of a batch without rewards is blown up to the size of a signal, and the policy drifts
    until it is sure of something arbitrary.
    """
    return (advantages - advantages.mean()) / max(
        float(advantages.std()),
        floor,
        1e-8,
    )


def explained_variance(values: Doubles, returns: Doubles) -> float:
    """The share of the variance of returns (n,) that their predictions (n,) explain; 0 where returns do not vary."""
    variance = float(returns.var())
    return 1 - float((returns - values).var()) / variance if variance > 0 else 0.0

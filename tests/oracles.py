"""The paper in plain Python: numbers and loops, nothing of torch, nothing of the package.

Each function says one equation of Cheng et al. (2023), https://doi.org/10.3389/fnbot.2023.1281166,
as slowly and as literally as possible; the tests compare the package with these.
"""

import math


def probabilities(priorities, alpha):
    """Eq. (8)."""
    total = sum(p**alpha for p in priorities)
    return [p**alpha / total for p in priorities]


def importance_weights(priorities, alpha, beta, sampled):
    """Eq. (10), N the size of the buffer, over the largest weight of the buffer."""
    number = len(priorities)
    weights = [(1 / number * 1 / p) ** beta for p in probabilities(priorities, alpha)]
    return [weights[slot] / max(weights) for slot in sampled]


def entropy(*outcomes):
    """Eq. (15), with 0 log 0 = 0."""
    return -sum(p * math.log2(p) for p in outcomes if p > 0)


def share(items, test):
    """Probability that an item passes a test."""
    return sum(1 for item in items if test(item)) / len(items)


def entropy_of_reward(rewards):
    """Eq. (16)."""
    average = sum(rewards) / len(rewards)
    above = share(rewards, lambda r: r > average)
    return entropy(above, 1 - above)


def entropy_of_positive(rewards):
    """Eq. (17)."""
    above = share(rewards, lambda r: r > 0)
    return entropy(above, 1 - above)


def fusion_weights(of_reward, of_td, of_loss):
    """Eqs. (18)-(20); equal weights where they would divide by zero."""
    total = of_reward + of_td + of_loss
    if total == 0:
        return 1 / 3, 1 / 3, 1 / 3
    a = of_reward / total
    beta = of_td / total
    return a, beta, 1 - a - beta


def fused(reward, td_error, gradient, weights, eps):
    """Eq. (21), of Eqs. (12)-(14): gradient is the vector dQ/da."""
    a, beta, nu = weights
    size = math.sqrt(sum(g * g for g in gradient))
    return (a * abs(reward) + beta * abs(td_error) + nu * size) + eps


def boosted(priority, reward, boost):
    """Eq. (22), for positive transitions only."""
    return max(boost * priority, 1.0) if reward > 0 else priority


def decayed(priorities, rewards, sharpness):
    """Eqs. (23)-(24); j is the place in the batch, counted from 1."""
    # A sum of equal numbers is rounded, and what is equal to the mean is not above it.
    threshold = math.fsum(priorities) / len(priorities) * (1 + 1e-12)
    after = []
    for j, (priority, reward) in enumerate(zip(priorities, rewards, strict=True), start=1):
        if reward > 0 and priority > threshold:
            priority = priority * (1 / (1 + math.exp(-sharpness * j)))
        after.append(priority)
    return after


def mpfa_priorities(batch, buffer_rewards, *, eps=0.05, boost=3.0, sharpness=0.01):
    """The whole chain of Algorithm 1 for a batch of (reward, td_error, gradient)."""
    of_positive = entropy_of_positive(buffer_rewards)
    weights = fusion_weights(entropy_of_reward(buffer_rewards), of_positive, of_positive)
    priorities = [fused(*transition, weights, eps) for transition in batch]
    rewards = [transition[0] for transition in batch]
    raised = [boosted(p, r, boost) for p, r in zip(priorities, rewards, strict=True)]
    return decayed(raised, rewards, sharpness)

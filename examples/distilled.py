"""DoorKey: options distilled from the plans of 300 layouts, tried on 100 that nobody played; ten minutes of a core.

Shows the preset `distilled`. In a new layout its options need no model and no training:

    hypogoal collect doorkey --out runs/far/data.h5
    hypogoal train-ensemble runs/far/data.h5 --out runs/far/ensemble
    hypogoal train-options runs/far/ensemble --preset distilled --out runs/far/options
    hypogoal evaluate runs/far --layouts 6000-6099

Then `python examples/distilled.py` plays each option once in one more layout; an agent over them learns by

    hypogoal train-meta runs/far/ensemble --options runs/far/options --preset distilled --out runs/far/meta
"""

import hypogoal


def play(layout_seed: int) -> list[str]:
    options = hypogoal.load_options("runs/far/options")
    env = hypogoal.OptionEnv(options.make_env(layout_seed=layout_seed), options, masked="run")
    lines = []
    for option in range(options.count):
        env.reset(seed=0)
        info = env.step(option)[4]
        end = "its member is positive" if info["reached"] else "its time is up, or the episode over"
        lines.append(f"{info['option']}: after {info['duration']} steps {end}")
    return lines


if __name__ == "__main__":
    print("\n".join(play(6100)))

"""`--cluster [ADDRESS]` on the command line."""

from __future__ import annotations

from typing import Annotated

import tyro

# No word after it: workers of this machine's.
ClusterOption = Annotated[tuple[str, ...] | None, tyro.conf.arg(metavar="[ADDRESS]")]


def chosen_cluster(words: tuple[str, ...] | None) -> bool | str:
    """What `render_animation` takes for the words after `--cluster`.

    Raises:
        ValueError: there is more than one.

    Example:
        >>> chosen_cluster(None), chosen_cluster(()), chosen_cluster(("tcp://10.0.0.5:8786",))
        (False, True, 'tcp://10.0.0.5:8786')
    """
    if words is None:
        return False
    if len(words) > 1:
        raise ValueError(f"cluster is {' '.join(words)}, expected one address, or none for this machine's cores")
    return words[0] if words else True

"""Methods by name: a class for each kind, and a file for each that needs code of its own."""

from typing import TYPE_CHECKING, Any

from torchrl_mpfa.lazy import find

if TYPE_CHECKING:
    from torchrl_mpfa.methods.assembly import Replay as Replay
    from torchrl_mpfa.methods.assembly import loss_options as loss_options
    from torchrl_mpfa.methods.assembly import make_replay as make_replay
    from torchrl_mpfa.methods.base import Method as Method
    from torchrl_mpfa.methods.base import Prioritized as Prioritized
    from torchrl_mpfa.methods.catalogue import ALIASES as ALIASES
    from torchrl_mpfa.methods.catalogue import METHODS as METHODS
    from torchrl_mpfa.methods.catalogue import MPFA as MPFA
    from torchrl_mpfa.methods.catalogue import Adjusted as Adjusted
    from torchrl_mpfa.methods.catalogue import Scaled as Scaled
    from torchrl_mpfa.methods.catalogue import method_named as method_named
    from torchrl_mpfa.methods.registered import SIGNALS as SIGNALS
    from torchrl_mpfa.methods.registered import OwnSignals as OwnSignals
    from torchrl_mpfa.methods.registered import register_signal as register_signal

_NAMES = {
    "assembly": "Replay loss_options make_replay",
    "base": "Method Prioritized",
    "catalogue": "ALIASES METHODS MPFA Adjusted Scaled method_named",
    "registered": "SIGNALS OwnSignals register_signal",
}
_MODULE_OF = {name: module for module, names in _NAMES.items() for name in names.split()}
__all__ = sorted(_MODULE_OF, key=lambda name: (not name.isupper(), name))


def __getattr__(name: str) -> Any:
    """Import a name when it is first used."""
    return find(__name__, name, _MODULE_OF)

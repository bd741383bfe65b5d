"""Networks of ours under the names of the published ones."""

from torch import Tensor, nn

from baselines.published import NETWORKS, published_name


def published_state_dict(variant: str, network: nn.Module) -> dict[str, Tensor]:
    """Return the weights of `network` as a checkpoint of the published network names them."""
    rules = NETWORKS[variant].rename_rules
    return {published_name(ours, rules): value for ours, value in network.state_dict().items()}

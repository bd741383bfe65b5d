"""Forms that are tried where they are installed, and networks that are traced."""

import jaxtyping
import pytest

from src.deploy import openvino_network


def form(name: str) -> str:
    """Return the form `name`, or skip where it is not installed."""
    if name == "openvino" and not openvino_network.is_installed():
        pytest.skip("needs the extra openvino")
    return name


@pytest.fixture
def unchecked():
    """Without the checks of annotations: to a network that is traced its sizes are tensors."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)

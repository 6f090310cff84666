"""Real, small object sets that the tests of several folders share."""

import pytest
from hypothesis import settings

from graspq.objects.object_set import ObjectSet
from graspq.objects.procedural import make_procedural
from graspq.objects.targeted import make_targeted

# Machines that others share are slow now and then; an example's time says nothing about the code.
settings.register_profile("shared-machine", deadline=None)
settings.load_profile("shared-machine")


@pytest.fixture(scope="session")
def regular_objects(tmp_path_factory: pytest.TempPathFactory) -> ObjectSet:
    """Thirty training and ten test objects of the project's own generator."""
    return make_procedural(tmp_path_factory.mktemp("objects") / "regular", seed=0, train=30, test=10)


@pytest.fixture(scope="session")
def targeted_objects(tmp_path_factory: pytest.TempPathFactory) -> ObjectSet:
    """The set of the targeted task."""
    return make_targeted(tmp_path_factory.mktemp("objects") / "targeted", seed=0)

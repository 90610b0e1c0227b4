"""The list of guards is whole and up to date; that removing each is noticed is shown by the slow one."""

import re

import pytest

from tests.stability.mutations import MUTATIONS, REPOSITORY, Mutation, survives

# There is no cache that could go stale, hence no guard against it.
WITHOUT_GUARD = {24}


def test_every_case_has_a_guard_that_is_there_once_and_a_test():
    assert {mutation.case for mutation in MUTATIONS} == set(range(1, 32)) - WITHOUT_GUARD
    for mutation in MUTATIONS:
        assert (REPOSITORY / mutation.file).read_text(encoding="utf-8").count(mutation.guard) == 1, mutation.guard
        file, test = mutation.test.split("[")[0].split("::")
        assert f"def {test}(" in (REPOSITORY / "tests" / "stability" / file).read_text(encoding="utf-8"), test
        assert int(re.findall(r"case_(\d\d)", test)[0]) == mutation.case


@pytest.mark.slow
@pytest.mark.parametrize(
    "mutation", MUTATIONS, ids=lambda mutation: f"{mutation.case}-{mutation.test.split('::')[1][:60]}"
)
def test_a_removed_guard_is_noticed(mutation: Mutation):
    assert not survives(mutation)

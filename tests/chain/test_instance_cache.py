"""Results of methods are computed once for each instance."""

from ertis_numba.chain.instance_cache import cached_in_instance


def test_cached_in_instance_computes_each_result_once():
    computed = []

    class Squares:
        @cached_in_instance
        def of(self, number):
            computed.append(number)
            return number**2

    squares = Squares()
    assert [squares.of(3), squares.of(3), Squares().of(3)] == [9, 9, 9]
    assert computed == [3, 3]

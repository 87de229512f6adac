"""Work on several numbers of threads, of which no bit of the results may depend."""

import torch


def assert_identical(first, second):
    """Of two sequences of tensors."""
    for a, b in zip(first, second, strict=True):
        assert torch.equal(a, b)


def same_on_threads(work, counts=(1, 2, 7)):
    """Asserts that a function makes the same tensors on so many threads, and returns them."""
    results = []
    for count in counts:
        torch.set_num_threads(count)
        results.append(list(work()))
        assert_identical(results[0], results[-1])
    return results[0]

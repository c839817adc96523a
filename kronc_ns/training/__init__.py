"""How the builtin keypoint detector is made: cars, pictures of them, a network, its training (extra ``train``)."""

"""One renderer entry point over slots: native kernels, and a slow float64 twin in torch."""

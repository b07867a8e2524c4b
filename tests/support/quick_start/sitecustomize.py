"""Read first by Python programs whose ``PYTHONPATH`` has this folder: nerfstudio lists no methods of others.

It looks through the sources of all modules for that, which takes more than ten seconds.
"""

import importlib.abc
import importlib.util
import sys


class WithoutMethodsOfOthers(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name != "nerfstudio.configs.external_methods":
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(name)
        run = spec.loader.exec_module

        def exec_module(module):
            run(module)
            module.get_external_methods = lambda: ({}, {})

        spec.loader.exec_module = exec_module
        return spec


sys.meta_path.insert(0, WithoutMethodsOfOthers())

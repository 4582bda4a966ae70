"""Settings of a sensor, as frozen structures that are read from TOML and written to it.

A structure checks its values when it is created and refuses unknown keys. ``Settings()`` describes the default eRTIS
measurement; ``Settings.from_preset`` returns the settings of an RTIS recording preset, and ``Processing.from_preset``
those of a processing preset.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

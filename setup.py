"""The build step that pyproject.toml cannot express: the wheel carries the experiments."""

from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py


class BuildWithExperiments(build_py):
    """Copies ``experiments/*.yaml`` into the package; an editable install reads the checkout's."""

    def run(self) -> None:
        """Builds the package, then adds the experiments."""
        super().run()
        if self.editable_mode:
            return
        target = Path(self.build_lib) / "fgslam" / "experiments"
        self.mkpath(str(target))
        for source in sorted(Path("experiments").glob("*.yaml")):
            self.copy_file(str(source), str(target / source.name))


setup(cmdclass={"build_py": BuildWithExperiments})

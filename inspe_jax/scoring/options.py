"""The options of a score: what the paper leaves open, which metrics, and which curves."""

from collections.abc import Sequence
from typing import NamedTuple

from inspe_jax.core.errors import InspeError
from inspe_jax.scoring.detection import DetectionCurves, detection_curves
from inspe_jax.scoring.metric import Metric
from inspe_jax.scoring.metrics import METRICS, chosen
from inspe_jax.scoring.reading import SightOptions
from inspe_jax.scoring.target_evidence import TargetEvidence


class ScoreOptions(NamedTuple):
    """The options of a score: the two that the paper leaves open, the metrics and the curves.

    Options as in :func:`inspe_jax.evaluate`; ``detection`` is None for the usual curves. Static:
    another value compiles another program.
    """

    occlusion_reference: str = "roi"
    visibility: str = "in_view"
    metrics: tuple[Metric, ...] = ()
    detection: DetectionCurves | None = None

    @classmethod
    def of(
        cls,
        occlusion_reference: str = "roi",
        visibility: str = "in_view",
        names: Sequence[str] | None = None,
        detection: DetectionCurves | None = None,
    ) -> "ScoreOptions":
        """These options, and the metrics of these names; the usual ones if None.

        Curves that equal the usual ones are the usual ones.
        """
        names = chosen() if names is None else names
        for name in names:
            if METRICS[name].name != name:
                words = f"METRICS['{name}'] has the name '{METRICS[name].name}': one name for both"
                raise InspeError(words)
        curves = None if detection == detection_curves() else detection
        return cls(occlusion_reference, visibility, tuple(METRICS[name] for name in names), curves)

    @property
    def sight(self) -> str | None:
        """What line of sight means, as ``visibility`` says it; None where no metric needs it.

        Metrics that need it where information gain does not are looked at past others.
        """
        if self.visibility != "in_view":
            return self.visibility
        return "past_others" if any(metric.sight for metric in self.metrics) else None

    @property
    def target_fields(self) -> tuple[str, ...]:
        """What the metrics read of what sensors have on road users; all, where one does not say."""
        if any(metric.terms and metric.targets is None for metric in self.metrics):
            return TargetEvidence._fields
        return tuple(sorted({name for metric in self.metrics for name in metric.targets or ()}))

    @property
    def counted(self) -> "ScoreOptions":
        """These options without what does not change the counts: fewer programs are compiled."""
        return ScoreOptions(self.occlusion_reference, self.sight or "in_view")

    @property
    def line_of_sight(self) -> SightOptions:
        """What line of sight is read for."""
        spares = self.occlusion_reference == "targets" or self.sight == "past_others"
        return SightOptions(self.sight, spares, any(metric.sight for metric in self.metrics))

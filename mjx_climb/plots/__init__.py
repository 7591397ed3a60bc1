"""Pictures of walks and of sweeps, for a column of a paper; colour-blind safe, SI units on every axis."""

from mjx_climb.lazy import lazy_names

TYPE_CHECKING = False
if TYPE_CHECKING:
    from mjx_climb.plots.events import detachments as detachments
    from mjx_climb.plots.events import disturbances as disturbances
    from mjx_climb.plots.events import grip_changes as grip_changes
    from mjx_climb.plots.events import largest_foot_force as largest_foot_force
    from mjx_climb.plots.feet import plot_feet as plot_feet
    from mjx_climb.plots.maps import color_scale as color_scale
    from mjx_climb.plots.maps import comparable as comparable
    from mjx_climb.plots.maps import failed_walks as failed_walks
    from mjx_climb.plots.maps import plot_map as plot_map
    from mjx_climb.plots.maps import plot_maps as plot_maps
    from mjx_climb.plots.maps import stability_lines as stability_lines
    from mjx_climb.plots.styling import BLACK as BLACK
    from mjx_climb.plots.styling import BLUE as BLUE
    from mjx_climb.plots.styling import CARGO as CARGO
    from mjx_climb.plots.styling import COLUMN as COLUMN
    from mjx_climb.plots.styling import FORMATS as FORMATS
    from mjx_climb.plots.styling import GREEN as GREEN
    from mjx_climb.plots.styling import ORANGE as ORANGE
    from mjx_climb.plots.styling import PURPLE as PURPLE
    from mjx_climb.plots.styling import PUSH as PUSH
    from mjx_climb.plots.styling import RED as RED
    from mjx_climb.plots.styling import SERIES as SERIES
    from mjx_climb.plots.styling import SKY as SKY
    from mjx_climb.plots.styling import VERMILLION as VERMILLION
    from mjx_climb.plots.styling import legend as legend
    from mjx_climb.plots.styling import legend_below as legend_below
    from mjx_climb.plots.styling import over_style as over_style
    from mjx_climb.plots.styling import save_figure as save_figure
    from mjx_climb.plots.styling import style as style
    from mjx_climb.plots.time_panels import thin as thin
    from mjx_climb.plots.walks import plot_comparison as plot_comparison
    from mjx_climb.plots.walks import plot_walk as plot_walk
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__)

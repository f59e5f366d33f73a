"""Where one frame of the skin ends and the next begins, in a stream of updates from patches without a common clock.

Every patch sends bursts: each of its modules once. A burst is over when one of its modules comes again, or after a
pause: half a period, or less if the patch's own pauses are shorter and stand out (long bursts). A frame holds at most
one burst of each patch. When one patch begins its next burst while another is in the middle of its own, that next
burst is held back until the other's is whole.

What was held up for long, or a device that sends far more often than it should, brings more bursts at once than the
ring has slots. Then the oldest of them are skipped; and if there still are too many, the last ones are not told apart.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from skinware_drivers.decoding.decoder import SkinState, Updates
from skinware_drivers.running.publisher import PatchLife, PublishPace
from tests.specification.decoding import join

Indices = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]
_NEVER = -1
_BEFORE = 0
_SIMILAR = 0.75  # what counts as such a pause again


class Bursts:
    """Fills one frame after the other.

    Args:
        state: what is shown; its owner calls ``begin_frame`` after each publication.
        pauses: between bursts, learnt here.
        pace: how long a burst may take.
        show: shows updates in ``state``.
        skip: told how many updates of each patch were skipped, (n_patches,) int64.
    """

    def __init__(
        self,
        state: SkinState,
        pauses: PatchLife,
        pace: PublishPace,
        show: Callable[[Updates], None],
        skip: Callable[[Indices], None],
    ) -> None:
        self._state = state
        self._group_patch = state.group_patch
        self._n_patches = len(state.patch_time_ns)
        self.pause_ns, self.standing_out_ns, self.gap_ns = pauses.pause_ns, pauses.standing_out_ns, pauses.gap_ns
        self._all_prompt = bool(state.is_prompt.all())
        self._first_group = np.searchsorted(self._group_patch, np.arange(self._n_patches))
        self._longest_pause_ns = pace.pause_ns
        self._show = show
        self._skip = skip
        self._left = 0  # publications of this take
        self._held: Updates | None = None

    @property
    def holds_back(self) -> bool:
        """Whether updates are held back for the sake of another patch's burst."""
        return self._held is not None

    def take(self, updates: Updates | None, living: Flags, publish: Callable[[], None], most: int) -> None:
        """Show updates, and what was held back before them, in as many frames as they belong to.

        Args:
            updates: what has arrived, in order of time; None: nothing new.
            living: (n_groups,) bool, update groups that can be expected to send.
            publish: called whenever a frame is over and more belongs to the next one.
            most: how often, at the most.
        """

        def count_and_publish() -> None:
            self._left -= 1
            publish()

        self._left = most
        parts = [part for part in (self._held, updates) if part is not None]
        self._held = None
        rest = self._skip_the_oldest(join(parts), most) if parts else None
        while rest is not None:
            if self._left <= 0:
                self._show_the_newest(rest)
                return
            rest = self._take_in_order(rest, living, count_and_publish)

    def _skip_the_oldest(self, updates: Updates, most: int) -> Updates:
        """The last updates of every group, so many at the most: as many bursts as can be published."""
        if len(updates) <= most:
            return updates
        order = np.argsort(updates.group, kind="stable")
        last = np.cumsum(np.bincount(updates.group, minlength=len(self._group_patch)))  # behind each group's own
        from_last = np.empty(len(updates), np.int64)
        from_last[order] = last[updates.group[order]] - np.arange(len(updates))
        old = from_last > max(1, most)
        if not old.any():
            return updates
        self._skip(np.bincount(self._group_patch[updates.group[old & updates.whole]], minlength=self._n_patches))
        return updates.take(~old)

    def _show_the_newest(self, updates: Updates) -> None:
        of_group = np.bincount(updates.group[updates.whole], minlength=len(self._group_patch))
        skipped = np.maximum(of_group + self._state.updated - 1, 0)
        self._skip(np.bincount(self._group_patch, skipped, self._n_patches).astype(np.int64))
        self._show(updates)

    def in_the_middle(self, living: Flags, time_ns: int) -> Flags:
        """(n_patches,) bool: patches whose burst has begun in this frame, is not whole, and not too old to go on."""
        lacks = np.zeros(self._n_patches, bool)
        missing = living & ~self._state.touched
        if not missing.any():
            return lacks
        lacks[self._group_patch[missing]] = True
        return self._begun() & lacks & (time_ns - self._state.patch_time_ns <= self.pause_ns)

    def pause_ends_ns(self, patches: Flags) -> int:
        """When the last of these patches will have said nothing for long enough to have ended its burst."""
        return int((self._state.patch_time_ns + self.pause_ns)[patches].max()) + 1

    def _begun(self) -> Flags:
        """(n_patches,) bool: patches of which this frame shows something."""
        begun = np.zeros(self._n_patches, bool)
        begun[self._group_patch[self._state.updated & self._state.is_prompt]] = True
        return begun

    def _take_in_order(self, updates: Updates, living: Flags, publish: Callable[[], None]) -> Updates | None:
        """Cut where bursts begin; returns what is left to be cut anew after a burst was drawn forward."""
        before = self._previous(updates)
        reach = np.maximum.accumulate(before)
        begin, threshold = 0, _BEFORE
        while begin < len(updates):
            end = int(np.searchsorted(reach, threshold))
            if end > begin:
                self._show(updates.take(slice(begin, end)))
            if end == len(updates):
                return None
            if self._left <= 0:
                return updates.take(slice(end, None))
            open_patches = self.in_the_middle(living, int(updates.oldest_ns[end]))
            open_patches[self._group_patch[updates.group[end]]] = False
            if open_patches.any():
                rest = updates.take(slice(end, None))
                return self._finish(rest, before[end:] >= threshold, open_patches, living, publish)
            publish()
            begin, threshold = end, end + 1
        return None

    def _finish(
        self, rest: Updates, begins: Flags, open_patches: Flags, living: Flags, publish: Callable[[], None]
    ) -> Updates | None:
        """Draw forward what belongs to the open bursts. If that ends them, publish; else hold the rest back.

        Returns:
            The rest, unless it is held back.
        """
        patch = self._group_patch[rest.group]
        early = np.zeros(len(rest), bool)
        for number in np.flatnonzero(open_patches).tolist():
            rows = np.flatnonzero(patch == number)
            next_burst = np.flatnonzero(begins[rows])
            if len(next_burst):
                rows = rows[: next_burst[0]]
                open_patches[number] = False
            early[rows] = True
        self._show(rest.take(early))
        rest = rest.take(~early)
        if (open_patches & self.in_the_middle(living, int(rest.newest_ns[-1]))).any():
            self._held = rest
            return None
        publish()
        return rest

    def _previous(self, updates: Updates) -> Indices:
        """(n,) for an update that begins a burst: 1 + the last update of the burst before, or 0 if that was shown.

        -1 for all others. So an update begins a new frame if its number lies within the present one.
        """
        group, patch = updates.group, self._group_patch[updates.group]
        previous = _chain(group)
        orphans = ~updates.whole
        orphans[previous == _NEVER] = False
        orphans[orphans] = ~updates.whole[previous[orphans]]  # two halves of one module that found no partners
        found = np.where(orphans, _NEVER, previous + 1)
        first = previous == _NEVER
        shown = np.where(updates.whole, self._state.touched[group], self._state.updated[group])
        found[first] = np.where(shown[first], _BEFORE, _NEVER)
        # slow groups come at any time: they neither begin nor end a burst
        prompt = np.arange(len(group)) if self._all_prompt else np.flatnonzero(self._state.is_prompt[group])
        if len(prompt):
            of_prompt = updates if self._all_prompt else updates.take(prompt)
            self._find_pauses(of_prompt, patch[prompt], prompt, found)
        return found

    def _find_pauses(self, updates: Updates, patch: Indices, rows: Indices, found: Indices) -> None:
        """See ``_previous``, where a pause lies before an update.

        Args:
            updates: of prompt groups.
            patch: of each.
            rows: where they are in ``found``.
            found: what is known already; filled in.
        """
        of_patch = _chain(patch)
        first = of_patch == _NEVER
        before_ns = np.where(first, self._state.patch_time_ns[patch], updates.newest_ns[of_patch])
        gap_ns = updates.oldest_ns - before_ns
        self._learn_pauses(updates.group, patch, gap_ns)
        pause = gap_ns > self.pause_ns[patch]
        if pause.any():
            pause &= ~first | self._begun()[patch]
            before = np.where(first, _NEVER, rows[of_patch])[pause] + 1
            found[rows[pause]] = np.maximum(found[rows[pause]], before)

    def _learn_pauses(self, group: Indices, patch: Indices, gap_ns: Indices) -> None:
        gap_ns = np.where(gap_ns < 2 * self._longest_pause_ns, gap_ns, 0)  # more than a period is no pause
        self.gap_ns[group] = gap_ns
        longest_ns = np.maximum.reduceat(self.gap_ns, self._first_group)
        np.maximum.at(longest_ns, patch, gap_ns)
        own_ns = np.where(longest_ns >= self.standing_out_ns, _SIMILAR * longest_ns, self._longest_pause_ns)
        self.pause_ns[:] = np.minimum(own_ns, self._longest_pause_ns)


def _chain(key: Indices) -> Indices:
    """(n,) the previous element of the same key, -1 for the first of each."""
    order = np.argsort(key.astype(np.uint16) if len(key) and key.max() < 1 << 16 else key, kind="stable")
    ordered = key[order]
    previous = np.full(len(key), _NEVER, np.int64)
    same = ordered[1:] == ordered[:-1]
    previous[order[1:][same]] = order[:-1][same]
    return previous

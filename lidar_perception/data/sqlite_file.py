"""SQLite files of rosbag2 (.db3), of any ROS 2 distribution, also where the recorder was killed."""

from __future__ import annotations

import sqlite3
from collections.abc import Collection
from pathlib import Path

from lidar_perception.data.storage import Stream, Topic

MAGIC = b"SQLite format 3\0"
NEEDED = {"topics": {"id", "name", "type"}, "messages": {"topic_id", "timestamp", "data"}}


class SqliteFile:
    """A database open for reading, see StorageFile. It and its folder may be read-only; nothing is
    written there. ValueError or sqlite3.Error where it is damaged."""

    def __init__(self, path: Path):
        # rosbags opens every file as immutable and so misses messages that are only in the -wal
        # file (rosbags/rosbag2/storage_sqlite3.py, Sqlite3Reader.open). In exclusive mode SQLite
        # reads that file without a -shm file; without locks this works in read-only folders.
        unfinished = any(_size(path.with_name(path.name + end)) for end in ("-wal", "-journal"))
        how = "mode=ro&vfs=unix-none" if unfinished else "immutable=1"
        self.database = sqlite3.connect(f"{path.absolute().as_uri()}?{how}", uri=True,
                                        check_same_thread=False)
        try:
            self.database.execute("PRAGMA locking_mode=EXCLUSIVE")
            self._read_topics()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self.database.close()

    def messages(self, ids: Collection[int], start: int, stop: int) -> Stream:
        """Yield (topic id, time, data) of topics, start <= time < stop, in order of time."""
        for topic, time, data in self.database.execute(
                f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN "
                f"({', '.join('?' * len(ids))}) AND timestamp >= ? AND timestamp < ? "
                "ORDER BY timestamp, rowid", (*ids, start, stop)):
            if not isinstance(data, bytes) or not isinstance(time, int):
                raise ValueError(f"a message of it is {type(data).__name__} at {time!r}")
            yield topic, time, data

    def _read_topics(self) -> None:
        columns = {table: {row[1] for row in self.database.execute(f"PRAGMA table_info({table})")}
                   for table in NEEDED}
        if any(NEEDED[table] - columns[table] for table in NEEDED):
            raise ValueError("it has no tables of topics and messages")
        # The first distributions knew neither encoding nor QoS.
        encoding, qos = (name if name in columns["topics"] else "''"
                         for name in ("serialization_format", "offered_qos_profiles"))
        counted = {topic: (count, first, last) for topic, count, first, last in
                   self.database.execute("SELECT topic_id, COUNT(*), MIN(timestamp), "
                                         "MAX(timestamp) FROM messages GROUP BY topic_id")}
        rows = self.database.execute(
            f"SELECT id, name, type, {encoding}, {qos} FROM topics ORDER BY id")
        self.topics = [Topic(number, name, kind, encoding, qos, counted.get(number, (0,))[0])
                       for number, name, kind, encoding, qos in rows]
        known = [counted[topic.id] for topic in self.topics if topic.id in counted]
        self.times = (min(first for _, first, _ in known),
                      max(last for *_, last in known)) if known else None


def _size(path: Path) -> int:
    return path.stat().st_size if path.is_file() else 0

import time,sys
from pathlib import Path
from tempfile import TemporaryDirectory, TemporaryFile
from benchmarks.bag_reading import *
from bags.tools.copies import What
def cut(bag, _):
    with TemporaryDirectory() as folder, Bag(bag) as source:
        return convert([source], Path(folder) / "copy", What(start="120", end="180")).messages
def cut_mcap(bag,_):
    from mcap.reader import make_reader
    from mcap.writer import Writer
    start, end = (START_NS + int(1e9 * s) for s in (120,180))
    with next(bag.glob("*.mcap")).open("rb") as stream, TemporaryFile() as out:
        writer = Writer(out); writer.start(); channel = writer.register_channel("/all", "cdr", 0)
        n=0
        for _, _, m in make_reader(stream).iter_messages(start_time=start, end_time=end):
            writer.add_message(channel, m.log_time, m.data, m.publish_time, m.sequence); n+=1
        writer.finish()
    return n
if __name__=="__main__":
    small=generated_bag(None, 300000)
    for name, f in (('cut',cut),('cut_mcap',cut_mcap),('framed',framed),('framed_rb',framed_by_rosbags),('copied',copied),('copied_rb',copied_by_rosbags)):
        print(name, timed(f, small, 300000))

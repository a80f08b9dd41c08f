// Caviar.cs: a game engine as a world of a CAVIAR run, over WebSocket. One file for Unity and .NET, no packages.
//
// Derive from World, override Step, and call Poll once a tick (or Run, in a program without a loop of its own):
//
//     class Street : World
//     {
//         protected override IEnumerable<WorldObject> Step(double t, double previous, IList<Command> commands)
//         {
//             yield return new WorldObject("car", "car", new[] { 10 * t, 0, 0.75 }, new[] { 4.5, 1.8, 1.5 });
//         }
//     }
//
// Poses are right-handed, in metres, z up, with x forward; Axes converts those of engines. The protocol is
// protocol/SPEC.md of the project. SPDX-License-Identifier: Apache-2.0
using System;
using System.Collections.Concurrent;
using System.Collections.Generic;
using System.Globalization;
using System.IO;
using System.Linq;
using System.Net.WebSockets;
using System.Reflection;
using System.Security.Cryptography;
using System.Text;
using System.Threading;

namespace Caviar
{
    /// <summary>Bytes that the protocol refuses, with the code of the ERROR that is due.</summary>
    public sealed class ProtocolException : Exception
    {
        /// <summary><c>malformed</c>, <c>limit</c> or <c>version</c>.</summary>
        public readonly string Code;

        public ProtocolException(string code, string message) : base(message) { Code = code; }

        internal static ProtocolException Malformed(string message)
        {
            return new ProtocolException("malformed", message);
        }
    }

    /// <summary>A map of the protocol: fields by name, defaults filled in where it was decoded.</summary>
    /// <remarks>Values are long, double, string, bool, null, List&lt;object&gt;, Map and NdArray.</remarks>
    public sealed class Map : Dictionary<string, object>
    {
        public long Whole(string key) { return Convert.ToInt64(this[key], CultureInfo.InvariantCulture); }
        public double Number(string key) { return Convert.ToDouble(this[key], CultureInfo.InvariantCulture); }
        public string Text(string key)
        {
            object found;
            return TryGetValue(key, out found) ? found as string ?? "" : "";
        }
        public bool Flag(string key) { return (bool)this[key]; }
        public Map Child(string key) { return this[key] as Map; }
        public List<object> List(string key) { return (List<object>)this[key]; }
        public double[] Numbers(string key)
        {
            return List(key).Select(value => Convert.ToDouble(value, CultureInfo.InvariantCulture)).ToArray();
        }
        public string[] Texts(string key) { return List(key).Cast<string>().ToArray(); }
        /// <summary>The array of a field, or null where the field is left out.</summary>
        public NdArray Array(string key)
        {
            object found;
            return TryGetValue(key, out found) ? (NdArray)found : null;
        }
    }

    /// <summary>An array of a product: element type, shape, and the elements as little-endian bytes in C
    /// order.</summary>
    public sealed class NdArray
    {
        internal static readonly Dictionary<string, int> Sizes = new Dictionary<string, int>
        {
            { "|b1", 1 }, { "|u1", 1 }, { "|i1", 1 }, { "<u2", 2 }, { "<i4", 4 }, { "<i8", 8 }, { "<u8", 8 },
            { "<f4", 4 }, { "<f8", 8 }, { "<c8", 8 }, { "<c16", 16 },
        };
        public readonly string Dtype;
        public readonly int[] Shape;
        public readonly byte[] Data;

        public NdArray(string dtype, int[] shape, byte[] data) { Dtype = dtype; Shape = shape; Data = data; }

        /// <summary>An array of float64 from rows of equal length; zeros are positive.</summary>
        public static NdArray Rows(int columns, IList<double[]> rows)
        {
            var data = new byte[8 * columns * rows.Count];
            for (int i = 0; i < rows.Count; i++)
                for (int j = 0; j < columns; j++)
                    Bytes.PutDouble(data, 8 * (i * columns + j), rows[i][j]);
            return new NdArray("<f8", new[] { rows.Count, columns }, data);
        }

        /// <summary>Elements as doubles; of complex ones real and imaginary parts in turn.</summary>
        public double[] ToDoubles()
        {
            int width = Dtype == "<c16" ? 8 : Dtype == "<c8" ? 4 : Sizes[Dtype];
            var found = new double[Data.Length / width];
            for (int i = 0; i < found.Length; i++)
            {
                int at = i * width;
                switch (Dtype)
                {
                    case "<f4": case "<c8": found[i] = Bytes.Single(Data, at); break;
                    case "<f8": case "<c16": found[i] = Bytes.Double(Data, at); break;
                    case "<u8": found[i] = (ulong)Bytes.Whole(Data, at, 8); break;
                    default: found[i] = Element(at, width); break;
                }
            }
            return found;
        }

        /// <summary>Elements of an array of integers or booleans; of uint64 the same 64 bits.</summary>
        public long[] ToLongs()
        {
            int width = Sizes[Dtype];
            var found = new long[Data.Length / width];
            for (int i = 0; i < found.Length; i++) found[i] = Element(i * width, width);
            return found;
        }

        private long Element(int at, int width)
        {
            long bits = Bytes.Whole(Data, at, width);
            return Dtype == "|i1" ? (sbyte)bits : Dtype == "<i4" ? (int)bits : bits;
        }
    }

    internal static class Bytes
    {
        public static long Whole(byte[] data, int at, int width)
        {
            long found = 0;
            for (int i = width - 1; i >= 0; i--) found = found << 8 | data[at + i];
            return found;
        }

        public static void PutWhole(byte[] data, int at, int width, long value)
        {
            for (int i = 0; i < width; i++) data[at + i] = (byte)(value >> 8 * i);
        }

        public static double Double(byte[] data, int at)
        {
            return BitConverter.Int64BitsToDouble(Whole(data, at, 8));
        }

        // -0.0 equals 0.0 and has other bytes: adding 0 makes equal values equal bytes.
        public static void PutDouble(byte[] data, int at, double value)
        {
            PutWhole(data, at, 8, BitConverter.DoubleToInt64Bits(value + 0.0));
        }

        public static float Single(byte[] data, int at)
        {
            if (BitConverter.IsLittleEndian) return BitConverter.ToSingle(data, at);
            return BitConverter.ToSingle(new[] { data[at + 3], data[at + 2], data[at + 1], data[at] }, 0);
        }

        public static byte[] Utf8(string text) { return Encoding.UTF8.GetBytes(text); }

        public static int Compare(string a, string b)
        {
            byte[] x = Utf8(a), y = Utf8(b);
            for (int i = 0; i < Math.Min(x.Length, y.Length); i++)
                if (x[i] != y[i]) return x[i] - y[i];
            return x.Length - y.Length;
        }

        public static string Sha256(params byte[][] pieces)
        {
            using (var hash = SHA256.Create())
            {
                foreach (var piece in pieces) hash.TransformBlock(piece, 0, piece.Length, piece, 0);
                hash.TransformFinalBlock(new byte[0], 0, 0);
                return string.Concat(hash.Hash.Select(value => value.ToString("x2")));
            }
        }
    }

    /// <summary>MessagePack as the protocol has it: no binary, no extensions; floats stay floats.</summary>
    public static class MessagePack
    {
        public const int MaxNesting = 32;
        private static readonly UTF8Encoding Strict = new UTF8Encoding(false, true);

        /// <summary>Write a value in canonical form: everything shortest, floats in nine bytes, keys of a Map
        /// sorted.</summary>
        public static byte[] Pack(object value)
        {
            var stream = new MemoryStream();
            Write(stream, value);
            return stream.ToArray();
        }

        internal static void Write(Stream to, object value)
        {
            if (value == null) to.WriteByte(0xc0);
            else if (value is bool) to.WriteByte((bool)value ? (byte)0xc3 : (byte)0xc2);
            else if (value is double)
            {
                to.WriteByte(0xcb);
                Big(to, BitConverter.DoubleToInt64Bits((double)value + 0.0), 8);
            }
            else if (value is long) WriteWhole(to, (long)value);
            else if (value is int) WriteWhole(to, (int)value);
            else if (value is string) WriteText(to, (string)value);
            else if (value is Map)
            {
                var map = (Map)value;
                Head(to, map.Count, 0x80, 16, 0, 0xde, 0xdf);
                foreach (var key in map.Keys.OrderBy(key => key, Comparer<string>.Create(Bytes.Compare)))
                {
                    WriteText(to, key);
                    Write(to, map[key]);
                }
            }
            else if (value is System.Collections.IList)
            {
                var list = (System.Collections.IList)value;
                Head(to, list.Count, 0x90, 16, 0, 0xdc, 0xdd);
                foreach (var item in list) Write(to, item);
            }
            else throw new ArgumentException("a " + value.GetType().Name + " has no place in a message");
        }

        internal static void Head(Stream to, int count, int small, int below, int one, int two, int four)
        {
            if (count < below) to.WriteByte((byte)(small | count));
            else if (one != 0 && count < 0x100) { to.WriteByte((byte)one); Big(to, count, 1); }
            else if (count < 0x10000) { to.WriteByte((byte)two); Big(to, count, 2); }
            else { to.WriteByte((byte)four); Big(to, count, 4); }
        }

        internal static void WriteText(Stream to, string text)
        {
            var bytes = Bytes.Utf8(text);
            Head(to, bytes.Length, 0xa0, 32, 0xd9, 0xda, 0xdb);
            to.Write(bytes, 0, bytes.Length);
        }

        private static void WriteWhole(Stream to, long value)
        {
            if (value >= 0)
            {
                if (value < 0x80) to.WriteByte((byte)value);
                else if (value < 0x100) { to.WriteByte(0xcc); Big(to, value, 1); }
                else if (value < 0x10000) { to.WriteByte(0xcd); Big(to, value, 2); }
                else if (value < 0x100000000) { to.WriteByte(0xce); Big(to, value, 4); }
                else { to.WriteByte(0xcf); Big(to, value, 8); }
            }
            else if (value >= -32) to.WriteByte((byte)value);
            else if (value >= -0x80) { to.WriteByte(0xd0); Big(to, value, 1); }
            else if (value >= -0x8000) { to.WriteByte(0xd1); Big(to, value, 2); }
            else if (value >= -0x80000000L) { to.WriteByte(0xd2); Big(to, value, 4); }
            else { to.WriteByte(0xd3); Big(to, value, 8); }
        }

        private static void Big(Stream to, long value, int width)
        {
            for (int i = width - 1; i >= 0; i--) to.WriteByte((byte)(value >> 8 * i));
        }

        /// <summary>Read one value that fills all bytes; raises ProtocolException where it does
        /// not.</summary>
        public static object Unpack(byte[] data)
        {
            int at = 0;
            var found = Read(data, ref at, 0);
            if (at != data.Length)
                throw ProtocolException.Malformed((data.Length - at) + " bytes after the end of the header");
            return found;
        }

        private static object Read(byte[] data, ref int at, int depth)
        {
            int code = Take(data, ref at, 1)[0];
            if (code < 0x80) return (long)code;
            if (code >= 0xe0) return (long)(sbyte)code;
            if (code < 0x90) return ReadMap(data, ref at, code & 0x0f, depth);
            if (code < 0xa0) return ReadList(data, ref at, code & 0x0f, depth);
            if (code < 0xc0) return ReadText(data, ref at, code & 0x1f);
            switch (code)
            {
                case 0xc0: return null;
                case 0xc2: return false;
                case 0xc3: return true;
                case 0xca:
                    var four = Take(data, ref at, 4);
                    Array.Reverse(four);
                    return (double)Bytes.Single(four, 0);
                case 0xcb: return BitConverter.Int64BitsToDouble(Big(data, ref at, 8));
                case 0xcc: return Big(data, ref at, 1);
                case 0xcd: return Big(data, ref at, 2);
                case 0xce: return Big(data, ref at, 4);
                case 0xcf:
                    long whole = Big(data, ref at, 8);
                    if (whole < 0)
                        throw ProtocolException.Malformed("an integer does not fit into 64 bits with a sign");
                    return whole;
                case 0xd0: return (long)(sbyte)Big(data, ref at, 1);
                case 0xd1: return (long)(short)Big(data, ref at, 2);
                case 0xd2: return (long)(int)Big(data, ref at, 4);
                case 0xd3: return Big(data, ref at, 8);
                case 0xd9: return ReadText(data, ref at, Big(data, ref at, 1));
                case 0xda: return ReadText(data, ref at, Big(data, ref at, 2));
                case 0xdb: return ReadText(data, ref at, Big(data, ref at, 4));
                case 0xdc: return ReadList(data, ref at, Big(data, ref at, 2), depth);
                case 0xdd: return ReadList(data, ref at, Big(data, ref at, 4), depth);
                case 0xde: return ReadMap(data, ref at, Big(data, ref at, 2), depth);
                case 0xdf: return ReadMap(data, ref at, Big(data, ref at, 4), depth);
                default: throw ProtocolException.Malformed("the byte 0x" + code.ToString("x2")
                    + " begins no value of a header");
            }
        }

        private static byte[] Take(byte[] data, ref int at, long count)
        {
            if (count > data.Length - at)
                throw ProtocolException.Malformed("the header ends in the middle of a value");
            var found = new byte[count];
            Buffer.BlockCopy(data, at, found, 0, (int)count);
            at += (int)count;
            return found;
        }

        private static long Big(byte[] data, ref int at, int width)
        {
            long found = 0;
            foreach (var value in Take(data, ref at, width)) found = found << 8 | value;
            return found;
        }

        private static string ReadText(byte[] data, ref int at, long count)
        {
            var bytes = Take(data, ref at, count);
            try { return Strict.GetString(bytes); }
            catch (ArgumentException) { throw ProtocolException.Malformed("a string is not UTF-8"); }
        }

        // A count costs nothing before its items are there: each takes a byte at least.
        private static void CheckCount(byte[] data, int at, long count, int depth)
        {
            if (depth >= MaxNesting)
                throw new ProtocolException("limit", "maps and lists nest deeper than " + MaxNesting);
            if (count > data.Length - at)
                throw ProtocolException.Malformed("a length announces more items than there are bytes");
        }

        private static List<object> ReadList(byte[] data, ref int at, long count, int depth)
        {
            CheckCount(data, at, count, depth);
            var found = new List<object>();
            for (long i = 0; i < count; i++) found.Add(Read(data, ref at, depth + 1));
            return found;
        }

        private static Map ReadMap(byte[] data, ref int at, long count, int depth)
        {
            CheckCount(data, at, count, depth);
            var found = new Map();
            for (long i = 0; i < count; i++)
            {
                var key = Read(data, ref at, depth + 1) as string;
                if (key == null) throw ProtocolException.Malformed("the key of a map is no string");
                found[key] = Read(data, ref at, depth + 1);
            }
            return found;
        }
    }

    /// <summary>Field types of all messages and payloads, from the text below that clients/schema.py
    /// makes.</summary>
    internal sealed class Schema
    {
        private const string Text = @"// schema: begin
Scene names:l(s) classes:l(s) assets:l(s) position:a(<f8,N,3) orientation:a(<f8,N,4) velocity:a(<f8,N,3) dimensions:a(<f8,N,3) devices:l(AntennaDevice/LidarDevice/CameraDevice)=[] angular_velocity:a(<f8,N,3)=?
Channel rung:s options:ChannelOptions={} expected_error_db:f=? carriers:l(Carrier) tx:l(s) rx:l(s) los:a(|b1,T,R) offsets:a(<i8,L1) object_names:l(s)=[] id:a(<u8,P) a:a(<c16,C,P) tau:a(<f8,P) aod:a(<f8,P,2) aoa:a(<f8,P,2) doppler:a(<f8,C,P) interactions:a(|u1,P,D) points:a(<f8,P,D,3) objects:a(<i4,P,D) h:l(ChannelMatrix)=[] dropped:i0=0 hf:l(ChannelResponse)=[] taps:l(ChannelTaps)=[] error_bound_db:a(<f8,T,R)=? error_reference:s='' used:a(|b1,C,T,R)=?
Lidar object_names:l(s) scans:l(LidarScan)
Camera images:l(CameraImage)
Depth images:l(DepthImage)
Segmentation object_names:l(s) material_names:l(s)=[] images:l(SegmentationImage)
Action commands:l(BeamChoice/WaypointCommand/VelocityCommand/UserSchedule/PathCommand/AttitudeCommand/DriveCommand/SignalCommand)
Link tx:l(s) rx:l(s) carrier:l(s) has_path:a(|b1,U) los:a(|b1,U) tx_beam:a(<i4,U) rx_beam:a(<i4,U) abs_y:a(<f8,U) top_tx_beam:a(<i4,U,K) top_rx_beam:a(<i4,U,K) top_abs_y:a(<f8,U,K) baseline_abs_y:a(<f8,U) aod_azimuth:a(<f8,U) aoa_azimuth:a(<f8,U) snr:a(<f8,U) snr_best:a(<f8,U) spectral_efficiency:a(<f8,U) bit_rate:a(<f8,U) reward:a(<f8,U) buffered:a(<f8,U)=? no_path:i0=0 serving:a(|b1,U)=? arrived:a(<i8,U)=? sent:a(<i8,U)=? dropped:a(<i8,U)=? delivered:a(<i8,U)=? delay:a(<f8,U)=? waiting:a(<f8,U)=? sinr:a(<f8,U)=? throughput:a(<f8,U)=? blocks:a(<i8,U)=? block_errors:a(<i8,U)=?
Hello:HELLO version:t2(i0) name:n role:e(world,channel,sensors,link,agent,recorder,observer) inputs:l256(Input)=[] outputs:l256(n)=[] capabilities:l256(s1..128)=[] implementation:s='' max_in_flight:i1..64=1 host:s='' pid:i0=0 subscriptions:l32(Subscription)=[]
Welcome:WELCOME version:t2(i0) run:s epoch:i1 attempt:i1 capabilities:l256(s1..128)=[] heartbeat_ns:i1 liveness_ns:i1 seed:i0=0 settings:m(*)={} scenario:m(*)={} rejoin_ns:i0=0
Refuse:REFUSE code:s1..128 message:s
Prepare:PREPARE epoch:i1 attempt:i1 demand:l256(Demand)=[] assets:l(Asset)=[] producers:m(l(s1..128))={} prefixes:m(l(s))={} max_faces:i0=0
AssetOffer:ASSET_OFFER epoch:i1 attempt:i1 assets:l(Asset)
AssetGet:ASSET_GET digest:d offset:i0=0
AssetData:ASSET_DATA digest:d offset:i0 size:i0
Ready:READY epoch:i1 attempt:i1 geometry:D='' prefixes:l(s)=[] actuators:l(s1..255)=[] notes:l(s)=[] seed:i-1=-1
Reset:RESET epoch:i1 attempt:i1 episode:i0 seed:i0 t0_ns:i seed_episode:i0=0
ResetDone:RESET_DONE epoch:i1 attempt:i1 episode:i0
Grant:GRANT epoch:i1 attempt:i1 episode:i0 frame:i0 previous_frame:i-1=-1 t_ns:i budget_ns:i0=0 inputs:l256(GrantInput)=[] final:b=false decisions:m(s)={} reports:l256(Report)=[]
Done:DONE epoch:i1 attempt:i1 episode:i0 frame:i0 products:l256(ProductHeader)=[] decisions:m(s)={} measured:m(i0)={} counts:m(i0)={} end_episode:b=false seed:i-1=-1 geometry:GeometryChange=? geometry_digest:D=''
Fault:FAULT epoch:i1 attempt:i1 episode:i0=0 frame:i-1=-1 phase:s message:s detail:s='' culprit:s=''
Cancel:CANCEL epoch:i1 attempt:i1 episode:i0 frame:i0
EpisodeEnd:EPISODE_END epoch:i1 attempt:i1 episode:i0 frames:i0
Checkpoint:CHECKPOINT epoch:i1 attempt:i1 episode:i0 frame:i0
CheckpointDone:CHECKPOINT_DONE epoch:i1 attempt:i1 episode:i0 frame:i0
Restore:RESTORE epoch:i1 attempt:i1 episode:i0 frame:i0
Geometry:GEOMETRY epoch:i1 attempt:i1 episode:i0 frame:i0 assets:l(Asset)=[]
GeometryDone:GEOMETRY_DONE epoch:i1 attempt:i1 episode:i0 frame:i0 geometry:D=''
Shutdown:SHUTDOWN reason:s grace_ns:i0=0
Bye:BYE epoch:i1 attempt:i1 reason:s=''
Stale:STALE of:s1..128 epoch:i1 attempt:i1 episode:i0 frame:i-1
Error:ERROR code:s1..128 message:s of:s='' subject:s=''
Observe:OBSERVE sequence:i0 state:s1..128 paused:b=false episode:i0=0 frame:i-1=-1 t_ns:i=0 inputs:l256(GrantInput)=[] reports:l256(Report)=[]
Observed:OBSERVED sequence:i0
Attach:ATTACH epoch:i1 attempt:i1 name:s1..128
Heartbeat:HEARTBEAT sequence:i0 progress:i0=0 phase:s='' grace_ns:i0=0
HeartbeatAck:HEARTBEAT_ACK sequence:i0
ChannelOptions los:b=true reflection:b=false refraction:b=false diffraction:b=false scattering:b=false max_depth:i0=0 samples:i0=0 materials_outside:l(s)=[] absorption_db_per_km:l(f0)=[] detail:s='' foliage:l(s)=[] blockage:l(s)=[]
Carrier name:s frequency_hz:f<0 bandwidth_hz:f<0=100000000.0 subcarriers:i0..65536=0 subcarrier_spacing_hz:f0=0.0 taps:i0..65536=0 slots:i1..65536=1 slot_duration_s:f0=0.0
ChannelMatrix carrier:i0 tx:i0 rx:i0 h:a(<c16,Nr,Nt)
ChannelResponse carrier:i0 tx:i0 rx:i0 h:a(<c8,S,K,Nr,Nt)
ChannelTaps carrier:i0 tx:i0 rx:i0 first:i h:a(<c8,S,L,Nr,Nt)
LidarScan sensor:s position:t3(f) orientation:t4(f) ray:a(<i4,N) points:a(<f4,N,3) points_world:a(<f4,N,3)=? range:a(<f4,N) object:a(<i4,N) grid:OccupancyGrid=?
CameraImage sensor:s intrinsics:Intrinsics position:t3(f) orientation:t4(f) rgb:a(|u1,H,W,3)
DepthImage sensor:s intrinsics:Intrinsics position:t3(f) orientation:t4(f) depth:a(<f4,H,W) normals:a(<f4,H,W,3)=?
SegmentationImage sensor:s intrinsics:Intrinsics position:t3(f) orientation:t4(f) object:a(<i4,H,W) material:a(<i4,H,W)=?
Asset name:p digest:d size:i0
GeometryChange frame:i0 assets:l(Asset)=[]
AntennaDevice:antenna name:s parent:s='' position:t3(f)=[0.0,0.0,0.0] orientation:t4(f)=[1.0,0.0,0.0,0.0] role:e(tx,rx,both) array:AntennaArray={} power_dbm:f=0.0 carriers:l(s)=[]
LidarDevice:lidar name:s parent:s='' position:t3(f)=[0.0,0.0,0.0] orientation:t4(f)=[1.0,0.0,0.0,0.0] beams:i1..1024=64 azimuth_steps:i1..36000=1800 elevation_min:f=-0.4363323129985824 elevation_max:f=0.05235987755982989 max_range:f<0=100.0 min_range:f0=0.0
CameraDevice:camera name:s parent:s='' position:t3(f)=[0.0,0.0,0.0] orientation:t4(f)=[1.0,0.0,0.0,0.0] width:i1..8192=640 height:i1..8192=480 field_of_view:f<0=1.5707963267948966
Intrinsics fx:f fy:f cx:f cy:f
BeamChoice:beam tx:s rx:s tx_beam:i0 rx_beam:i0=0 carrier:s=''
WaypointCommand:waypoint object:s position:t3(f) speed:f<0 at_once:b=false yaw:f=?
VelocityCommand:velocity object:s velocity:t3(f) yaw:f=? yaw_rate:f=?
UserSchedule:schedule tx:s rx:s
PathCommand:path object:s points:l(t3(f)) speed:f<0
AttitudeCommand:attitude object:s orientation:t4(f) thrust:f0
DriveCommand:drive object:s speed:f0=? lane:i0=? route:l(s)=[] stop:RoadStop=?
SignalCommand:signal signal:s phase:i0 duration:f<0=?
Input topic:n lag:i0..1=0 required:b=true parts:l256(s1..128)=[]
Subscription topic:n source:s='' every:i1=1
Demand topic:s1..128 parts:l256(s1..128)=[]
GrantInput topic:s1..128 source:s1..128 status:e(fresh,held,absent,late) frame:i-1=-1 t_ns:i=0 age:i0=0 fidelity:s='' digest:D='' cause:s='' geometry:D=''
Report source:s1..128 decisions:m(s)={} measured:m(i0)={} counts:m(i0)={} geometry:GeometryChange=?
ProductHeader topic:s1..128 digest:d fidelity:s=''
AntennaArray rows:i1..1024=1 columns:i1..1024=1 vertical_spacing:f<0=0.5 horizontal_spacing:f<0=0.5 pattern:e(iso,dipole,hw_dipole,tr38901)='iso' polarization:e(V,H,-45,+45,RHCP,LHCP,VH,cross,circular)='V' pattern_file:s='' panels:l(Panel)=[] codebook:s='dft'
OccupancyGrid origin:t3(f) cell:t3(f) occupancy:a(|i1,X,Y,Z)
RoadStop road:s position:f0 duration:f0 lane:i0=0
Panel position_m:t3(f)=[0.0,0.0,0.0] yaw_deg:f=0.0 pitch_deg:f=0.0 roll_deg:f=0.0
=Scene N:names,classes,assets
=Channel C:carriers
=Channel T:tx
=Channel R:rx
=Link U:tx,rx,carrier
@topics scene:Scene channel:Channel lidar:Lidar camera:Camera depth:Depth segmentation:Segmentation action:Action link:Link
// schema: end";

        public sealed class FieldType
        {
            public char Kind;               // i f s n p d D b * e l t m a, S for structs
            public double Low = double.NegativeInfinity, High = double.PositiveInfinity;
            public bool Above;              // greater than Low, not equal
            public int Fewest, Most = int.MaxValue;
            public FieldType Inner;
            public string[] Words;          // of enumerations, structs, and arrays: dtype and sizes
        }

        public sealed class Field
        {
            public string Name;
            public FieldType Type;
            public bool Required = true, LeftOut;
            public object Default;
        }

        public readonly string Name, Tag;
        public readonly List<Field> Fields = new List<Field>();
        private readonly Dictionary<string, string[]> _sizes = new Dictionary<string, string[]>();

        public static readonly Dictionary<string, Schema> Structs = new Dictionary<string, Schema>();
        public static readonly Dictionary<string, Schema> Messages = new Dictionary<string, Schema>();
        public static readonly Dictionary<string, Schema> Topics = new Dictionary<string, Schema>();

        static Schema()
        {
            foreach (var line in Text.Split('\n').Select(line => line.Trim())
                .Where(line => line != "" && line[0] != '/'))
            {
                var words = line.Split(' ');
                if (line[0] == '=')
                    foreach (var size in words.Skip(1))
                        Structs[words[0].Substring(1)]._sizes[size.Split(':')[0]] = 
                            size.Split(':')[1].Split(',');
                else if (line[0] == '@')
                    foreach (var topic in words.Skip(1))
                        Topics[topic.Split(':')[0]] = Structs[topic.Split(':')[1]];
                else new Schema(words);
            }
        }

        private Schema(string[] words)
        {
            Name = words[0].Split(':')[0];
            Tag = words[0].Contains(":") ? words[0].Split(':')[1] : null;
            Structs[Name] = this;
            if (Tag != null && Tag == Tag.ToUpperInvariant()) Messages[Tag] = this;
            foreach (var word in words.Skip(1))
            {
                int colon = word.IndexOf(':'), equals = word.IndexOf('=', colon);
                var field = new Field { Name = word.Substring(0, colon) };
                field.Type = Parse(equals < 0 ? word.Substring(colon + 1)
                    : word.Substring(colon + 1, equals - colon - 1));
                if (equals >= 0)
                {
                    field.Required = false;
                    field.LeftOut = word.Substring(equals + 1) == "?";
                    if (!field.LeftOut) field.Default = DefaultOf(word.Substring(equals + 1), field.Type);
                }
                Fields.Add(field);
            }
        }

        private static FieldType Parse(string text)
        {
            var type = new FieldType { Kind = text[0] };
            int open = text.IndexOf('(');
            string head = open < 0 ? text.Substring(1) : text.Substring(1, open - 1);
            string inner = open < 0 ? "" : text.Substring(open + 1, text.Length - open - 2);
            if (char.IsUpper(text[0]) && text != "D") { type.Kind = 'S'; type.Words = text.Split('/'); }
            else if (text[0] == 'l')
            {
                type.Inner = Parse(inner);
                if (head != "") type.Most = int.Parse(head);
            }
            else if (text[0] == 't') { type.Inner = Parse(inner); type.Fewest = type.Most = int.Parse(head); }
            else if (text[0] == 'm') type.Inner = Parse(inner);
            else if (text[0] == 'e' || text[0] == 'a') type.Words = inner.Split(',');
            else if (text[0] == 's' && head != "")
            {
                type.Fewest = int.Parse(head.Split('.')[0]);
                type.Most = int.Parse(head.Split('.')[2]);
            }
            else if (head != "")
            {
                type.Above = head[0] == '<';
                var ends = head.TrimStart('<').Split(new[] { ".." }, StringSplitOptions.None);
                type.Low = double.Parse(ends[0], CultureInfo.InvariantCulture);
                if (ends.Length > 1) type.High = double.Parse(ends[1], CultureInfo.InvariantCulture);
            }
            return type;
        }

        private static object DefaultOf(string text, FieldType type)
        {
            switch (type.Kind)
            {
                case 'b': return text == "true";
                case 'i': return long.Parse(text, CultureInfo.InvariantCulture);
                case 'f': return double.Parse(text, CultureInfo.InvariantCulture);
                case 'l': return new List<object>();
                case 't':
                    return text.Trim('[', ']').Split(',')
                        .Select(item => DefaultOf(item, type.Inner)).ToList();
                case 'm': case 'S': return new Map();
                default: return text.Trim('\'');
            }
        }

        // --- reading: types are checked, defaults filled in, arrays taken from the body --------------------

        /// <summary>A map as a struct of this kind; raises ProtocolException where it is none.</summary>
        public Map Read(object value, BodyReader body, string place)
        {
            var map = value as Map;
            if (map == null) throw ProtocolException.Malformed(place + " is no map");
            var found = new Map();
            if (Tag != null) found["type"] = Tag;
            var sizes = new Dictionary<string, int>();
            foreach (var field in Fields)
            {
                object given;
                if (map.TryGetValue(field.Name, out given))
                    found[field.Name] = ReadField(field.Type, given, body, place + "." + field.Name, sizes);
                else if (field.Required)
                    throw ProtocolException.Malformed(place + "." + field.Name + " is missing");
                else if (field.Type.Kind == 'S' && !field.LeftOut)
                    found[field.Name] = Structs[field.Type.Words[0]].Read(new Map(), body, place);
                else if (!field.LeftOut) found[field.Name] = field.Default;
            }
            foreach (var size in _sizes)
                foreach (var list in size.Value)
                    Agree(sizes, size.Key, found.List(list).Count, place + "." + list);
            if (Name == "Channel") CheckOffsets(found, place);
            return found;
        }

        private static void Agree(Dictionary<string, int> sizes, string name, int count, string place)
        {
            int fixedSize, known;
            bool wrong = int.TryParse(name, out fixedSize) ? count != fixedSize
                : sizes.TryGetValue(name, out known) && known != count;
            if (wrong)
                throw ProtocolException.Malformed(place + " has " + count + " where " + name
                    + " is another size");
            sizes[name] = count;
        }

        private static void CheckOffsets(Map channel, string place)
        {
            long[] offsets = channel.Array("offsets").ToLongs();
            int pairs = channel.List("tx").Count * channel.List("rx").Count;
            bool right = offsets.Length == pairs + 1 && offsets[0] == 0
                && offsets[pairs] == channel.Array("tau").Shape[0];
            for (int i = 0; right && i < pairs; i++) right = offsets[i] <= offsets[i + 1];
            if (!right)
                throw ProtocolException.Malformed(place + ".offsets do not count the paths of " + pairs
                    + " pairs");
        }

        private static object ReadField(FieldType type, object value, BodyReader body, string place,
            Dictionary<string, int> sizes)
        {
            switch (type.Kind)
            {
                case '*': return value;
                case 'b': if (value is bool) return value; break;
                case 'i': if (value is long && InBounds(type, (long)value)) return value; break;
                case 'f':
                    if (value is long) value = (double)(long)value;
                    if (value is double && InBounds(type, (double)value)) return value;
                    break;
                case 'e': if (type.Words.Contains(value as string)) return value; break;
                case 'l': case 't':
                    var list = value as List<object>;
                    if (list == null || list.Count < type.Fewest || list.Count > type.Most) break;
                    return list
                        .Select((item, i) => ReadField(type.Inner, item, body, place + "[" + i + "]", sizes))
                        .ToList();
                case 'm':
                    if (!(value is Map)) break;
                    var map = new Map();
                    foreach (var pair in (Map)value)
                    {
                        string inner = place + "." + pair.Key;
                        map[pair.Key] = ReadField(type.Inner, pair.Value, body, inner, sizes);
                    }
                    return map;
                case 'S':
                    if (!(value is Map)) break;
                    if (type.Words.Length == 1) return Structs[type.Words[0]].Read(value, body, place);
                    var tagged = type.Words.FirstOrDefault(name =>
                        Structs[name].Tag == ((Map)value).Text("type"));
                    if (tagged == null) break;
                    return Structs[tagged].Read(value, body, place);
                case 'a':
                    var array = body.Read(value, place);
                    if (array.Dtype != type.Words[0] || array.Shape.Length != type.Words.Length - 1) break;
                    for (int i = 0; i < array.Shape.Length; i++)
                        Agree(sizes, type.Words[i + 1], array.Shape[i], place);
                    return array;
                default: if (value is string && IsText(type, (string)value)) return value; break;
            }
            throw ProtocolException.Malformed(place + " is not what its field holds: " + Shown(value));
        }

        private static bool InBounds(FieldType type, double value)
        {
            return !double.IsNaN(value) && !double.IsInfinity(value)
                && (type.Above ? value > type.Low : value >= type.Low) && value <= type.High;
        }

        private static bool IsText(FieldType type, string text)
        {
            switch (type.Kind)
            {
                case 'd': return text.Length == 64 && IsHex(text);
                case 'D': return text == "" || text.Length == 64 && IsHex(text);
                case 'n': return text.Length >= 1 && Length(text) <= 128 && IsPrintable(text);
                case 'p': return IsPath(text);
                default: return Length(text) >= type.Fewest && Length(text) <= type.Most;
            }
        }

        /// <summary>Whether a text is the name of an asset: a relative path that stays below its folder.</summary>
        internal static bool IsPath(string text)
        {
            return Length(text) <= 255 && IsPrintable(text) && !text.Contains("\\")
                && text.Split('/').All(segment => segment != "" && segment != "." && segment != "..");
        }

        // Characters as the protocol counts them: code points, and not halves of surrogate pairs.
        private static int Length(string text)
        {
            return text.Count(character => !char.IsLowSurrogate(character));
        }
        private static bool IsHex(string text)
        {
            return text.All(c => c >= '0' && c <= '9' || c >= 'a' && c <= 'f');
        }
        internal static bool IsPrintable(string text) { return text.All(c => c >= ' ' && c != '\x7f'); }

        private static string Shown(object value)
        {
            string text = value == null ? "nil" : value is string ? "'" + value + "'"
                : Convert.ToString(value, CultureInfo.InvariantCulture);
            return text.Length > 80 ? text.Substring(0, 80) + "…" : text;
        }

        // --- writing: canonical form, in which a field that equals its default is left out -----------------

        /// <summary>Write a struct; fields that are missing have their defaults, keys that it does not have
        /// are ignored.</summary>
        public void Write(Stream to, Map map, BodyWriter body)
        {
            var kept = new List<KeyValuePair<string, byte[]>>();
            foreach (var field in Fields)
            {
                object value;
                if (!map.TryGetValue(field.Name, out value) || value == null)
                {
                    if (field.Required) throw new ArgumentException(Name + " has no " + field.Name);
                    continue;
                }
                var bytes = Written(field.Type, value, body, Name + "." + field.Name);
                bool standard = !field.Required && !field.LeftOut
                    && (field.Type.Kind == 'S' ? bytes.Length == 1 && bytes[0] == 0x80
                        : IsDefault(value, field));
                if (!standard) kept.Add(new KeyValuePair<string, byte[]>(field.Name, bytes));
            }
            MessagePack.Head(to, kept.Count + (Tag == null ? 0 : 1), 0x80, 16, 0, 0xde, 0xdf);
            if (Tag != null) { MessagePack.WriteText(to, "type"); MessagePack.WriteText(to, Tag); }
            foreach (var pair in kept)
            {
                MessagePack.WriteText(to, pair.Key);
                to.Write(pair.Value, 0, pair.Value.Length);
            }
        }

        private static bool IsDefault(object value, Field field)
        {
            if (field.Type.Kind == 'f')
                return Convert.ToDouble(value, CultureInfo.InvariantCulture) == (double)field.Default;
            if (field.Type.Kind == 'i')
                return Convert.ToInt64(value, CultureInfo.InvariantCulture) == (long)field.Default;
            if (field.Type.Kind == 't')
                return ((System.Collections.IEnumerable)value).Cast<object>()
                    .Select(item => Convert.ToDouble(item, CultureInfo.InvariantCulture))
                    .SequenceEqual(((List<object>)field.Default).Select(item => (double)item));
            if (field.Type.Kind == 'l' || field.Type.Kind == 'm')
                return ((System.Collections.ICollection)value).Count == 0;
            return value.Equals(field.Default);
        }

        private static byte[] Written(FieldType type, object value, BodyWriter body, string place)
        {
            var to = new MemoryStream();
            switch (type.Kind)
            {
                case 'f':
                    double number = Convert.ToDouble(value, CultureInfo.InvariantCulture);
                    if (double.IsNaN(number) || double.IsInfinity(number))
                        throw new ArgumentException(place + " is " + number + "; it has to be finite");
                    MessagePack.Write(to, number);
                    break;
                case 'i': MessagePack.Write(to, Convert.ToInt64(value, CultureInfo.InvariantCulture)); break;
                case 'l': case 't':
                    var items = (System.Collections.ICollection)value;
                    MessagePack.Head(to, items.Count, 0x90, 16, 0, 0xdc, 0xdd);
                    foreach (var item in items) Copy(to, Written(type.Inner, item, body, place));
                    break;
                case 'm':
                    MessagePack.Head(to, ((Map)value).Count, 0x80, 16, 0, 0xde, 0xdf);
                    foreach (var pair in ((Map)value).OrderBy(pair => pair.Key,
                        Comparer<string>.Create(Bytes.Compare)))
                    {
                        MessagePack.WriteText(to, pair.Key);
                        Copy(to, Written(type.Inner, pair.Value, body, place));
                    }
                    break;
                case 'S':
                    var map = (Map)value;
                    var name = type.Words.Length == 1 ? type.Words[0]
                        : type.Words.First(word => Structs[word].Tag == map.Text("type"));
                    Structs[name].Write(to, map, body);
                    break;
                case 'a': body.Place((NdArray)value).WriteTo(to); break;
                default: MessagePack.Write(to, value); break;
            }
            return to.ToArray();
        }

        private static void Copy(Stream to, byte[] bytes) { to.Write(bytes, 0, bytes.Length); }
    }

    /// <summary>Takes the arrays of a product out of its body, in the order of their references.</summary>
    internal sealed class BodyReader
    {
        private readonly byte[] _body;
        private long _end;

        public BodyReader(byte[] body) { _body = body; }

        public NdArray Read(object value, string place)
        {
            var reference = value as Map;
            object dtype = null, shape = null, offset = null;
            if (reference == null || !reference.TryGetValue("dtype", out dtype)
                || !reference.TryGetValue("shape", out shape)
                || !reference.TryGetValue("offset", out offset) || !(dtype is string)
                || !(shape is List<object>) || !(offset is long))
                throw ProtocolException.Malformed(place + " is no reference to an array");
            var sizes = (List<object>)shape;
            int width;
            if (!NdArray.Sizes.TryGetValue((string)dtype, out width))
                throw ProtocolException.Malformed(place + ": no element is a '" + dtype + "'");
            if (sizes.Count > 6)
                throw new ProtocolException("limit", place + " has " + sizes.Count
                    + " dimensions; at most 6 may travel");
            if (sizes.Any(size => !(size is long) || (long)size < 0 || (long)size > int.MaxValue))
                throw ProtocolException.Malformed(place + ": the shape is no list of sizes");
            // The product of sizes may exceed 64 bits; a body never does.
            double length = sizes.Aggregate((double)width, (product, size) => product * (long)size);
            long begin = (long)offset;
            if (begin < _end || begin % 8 != 0 || length > _body.Length
                || begin > _body.Length - (long)length)
                throw ProtocolException.Malformed(place + ": the array at " + begin
                    + " does not lie in its place of the body");
            var data = new byte[(int)length];
            Buffer.BlockCopy(_body, (int)begin, data, 0, data.Length);
            if ((string)dtype == "|b1" && data.Any(element => element > 1))
                throw ProtocolException.Malformed(place + ": a boolean is 0 or 1");
            _end = begin + data.Length;
            return new NdArray((string)dtype, sizes.Select(size => (int)(long)size).ToArray(), data);
        }
    }

    /// <summary>Lays arrays one after another, each at the next multiple of 8 bytes.</summary>
    internal sealed class BodyWriter
    {
        private readonly MemoryStream _body = new MemoryStream();

        public MemoryStream Place(NdArray array)
        {
            while (_body.Length % 8 != 0) _body.WriteByte(0);
            var reference = new MemoryStream();
            MessagePack.Head(reference, 3, 0x80, 16, 0, 0xde, 0xdf);
            MessagePack.WriteText(reference, "dtype");
            MessagePack.WriteText(reference, array.Dtype);
            MessagePack.WriteText(reference, "shape");
            MessagePack.Write(reference, array.Shape.Select(size => (object)(long)size).ToList());
            MessagePack.WriteText(reference, "offset");
            MessagePack.Write(reference, _body.Length);
            _body.Write(array.Data, 0, array.Data.Length);
            return reference;
        }

        public byte[] ToArray() { return _body.ToArray(); }
    }

    /// <summary>One product: header, body, and the digest over both.</summary>
    public sealed class Product
    {
        public readonly byte[] Header, Body;
        public readonly string Digest;

        public Product(byte[] header, byte[] body)
        {
            Header = header;
            Body = body;
            Digest = DigestOf(header, body);
        }

        public static string DigestOf(byte[] header, byte[] body)
        {
            var length = new byte[8];
            Bytes.PutWhole(length, 0, 8, header.Length);
            return Bytes.Sha256(length, header, body);
        }
    }

    /// <summary>Messages and products to bytes and back, checked against the schema.</summary>
    public static class Codec
    {
        public const int MaxHeader = 1 << 20, MaxParts = 513, MaxAssetChunk = 4 << 20;

        public static byte[] EncodeMessage(string type, Map fields)
        {
            var to = new MemoryStream();
            Schema.Messages[type].Write(to, fields, null);
            return to.ToArray();
        }

        /// <summary>The fields of a message's first part; raises ProtocolException.</summary>
        public static Map DecodeMessage(byte[] header)
        {
            if (header.Length > MaxHeader)
                throw new ProtocolException("limit", "the header has " + header.Length + " B; at most "
                    + MaxHeader + " may travel");
            var map = MessagePack.Unpack(header) as Map;
            if (map == null) throw ProtocolException.Malformed("the header is no map");
            Schema schema;
            if (!Schema.Messages.TryGetValue(map.Text("type"), out schema))
                throw ProtocolException.Malformed("no message is a '" + map.Text("type") + "'");
            if (schema.Tag == "HELLO" || schema.Tag == "WELCOME")
            {
                object version;
                map.TryGetValue("version", out version);
                var pair = version as List<object>;
                if (pair != null && pair.Count == 2 && pair[0] is long && pair[1] is long
                    && (long)pair[0] >= 0 && (long)pair[0] != 1)
                    throw new ProtocolException("version", "the peer speaks version " + pair[0] + "."
                        + pair[1] + " of the protocol, this client 1.5");
            }
            return schema.Read(map, null, schema.Tag);
        }

        /// <summary>Check that a message has the parts that its header announces.</summary>
        public static void CheckParts(Map message, IList<byte[]> parts)
        {
            string type = message.Text("type");
            int products = type == "GRANT" || type == "OBSERVE"
                ? message.List("inputs").Count(input => ((Map)input).Text("status") != "absent")
                : type == "DONE" ? message.List("products").Count : 0;
            int raw = type == "ASSET_DATA" || type == "CHECKPOINT_DONE" || type == "RESTORE" ? 1 : 0;
            if (parts.Count != 1 + 2 * products + raw)
                throw ProtocolException.Malformed(type + " has " + (parts.Count - 1)
                    + " further parts, and its header announces " + (2 * products + raw));
            for (int i = 1; i < 2 * products; i += 2)
                if (parts[i].Length > MaxHeader)
                    throw new ProtocolException("limit", "a product's header has " + parts[i].Length
                        + " B; at most " + MaxHeader + " may travel");
            if (type != "ASSET_DATA") return;
            if (parts[1].Length > MaxAssetChunk)
                throw new ProtocolException("limit", "ASSET_DATA brings " + parts[1].Length + " B; at most "
                    + MaxAssetChunk + " may travel");
            if (message.Whole("offset") > message.Whole("size") - parts[1].Length)
                throw ProtocolException.Malformed("ASSET_DATA reaches beyond the size that it states");
        }

        public static Product EncodePayload(string topic, Map value)
        {
            MemoryStream header = new MemoryStream();
            var body = new BodyWriter();
            Schema.Topics[topic].Write(header, value, body);
            return new Product(header.ToArray(), body.ToArray());
        }

        /// <summary>The fields of a product, with its arrays; raises ProtocolException.</summary>
        public static Map DecodePayload(string topic, byte[] header, byte[] body)
        {
            if (header.Length > MaxHeader)
                throw new ProtocolException("limit", "the header has " + header.Length + " B; at most "
                    + MaxHeader + " may travel");
            Schema schema;
            if (!Schema.Topics.TryGetValue(topic, out schema))
                throw ProtocolException.Malformed("no topic is called '" + topic + "'");
            return schema.Read(MessagePack.Unpack(header), new BodyReader(body), topic);
        }

        /// <summary>Arrays of a list of references, as they stand in a body.</summary>
        public static List<NdArray> DecodeArrays(byte[] references, byte[] body)
        {
            var list = MessagePack.Unpack(references) as List<object>;
            if (list == null) throw ProtocolException.Malformed("no list of references");
            var reader = new BodyReader(body);
            return list.Select(reference => reader.Read(reference, "array")).ToList();
        }

        /// <summary>A message as one WebSocket frame.</summary>
        public static byte[] Join(params byte[][] parts)
        {
            var frame = new byte[4 * (1 + parts.Length) + parts.Sum(part => part.Length)];
            Bytes.PutWhole(frame, 0, 4, parts.Length);
            int at = 4 * (1 + parts.Length);
            for (int i = 0; i < parts.Length; i++)
            {
                Bytes.PutWhole(frame, 4 * (i + 1), 4, parts[i].Length);
                Buffer.BlockCopy(parts[i], 0, frame, at, parts[i].Length);
                at += parts[i].Length;
            }
            return frame;
        }

        /// <summary>The parts of a WebSocket frame; raises ProtocolException.</summary>
        public static List<byte[]> Split(byte[] frame)
        {
            long count = frame.Length < 4 ? 0 : Bytes.Whole(frame, 0, 4);
            if (count < 1 || count > MaxParts || frame.Length < 4 * (1 + count))
                throw ProtocolException.Malformed("the frame states " + count + " parts");
            var parts = new List<byte[]>();
            long at = 4 * (1 + count);
            for (int i = 1; i <= count; i++)
            {
                long length = Bytes.Whole(frame, 4 * i, 4);
                if (length > frame.Length - at)
                    throw ProtocolException.Malformed("part " + (i - 1) + " of the frame ends past it");
                var part = new byte[length];
                Buffer.BlockCopy(frame, (int)at, part, 0, (int)length);
                parts.Add(part);
                at += length;
            }
            if (at != frame.Length)
                throw ProtocolException.Malformed("the frame has bytes after its last part");
            return parts;
        }
    }

    // --- Axes ----------------------------------------------------------------------------------------------

    /// <summary>Position, and unit quaternion (w, x, y, z) that rotates body axes into world axes.</summary>
    public struct Pose
    {
        public readonly double[] Position, Orientation;
        public Pose(double[] position, double[] orientation)
        {
            Position = position;
            Orientation = orientation;
        }
    }

    /// <summary>Velocity, and angular velocity [rad/s] that turns by the hand of the axes.</summary>
    public struct Motion
    {
        public readonly double[] Velocity, AngularVelocity;
        public Motion(double[] velocity, double[] angularVelocity)
        {
            Velocity = velocity;
            AngularVelocity = angularVelocity;
        }
    }

    /// <summary>A mesh in body axes: rows of x, y, z, and of the vertices of each triangle.</summary>
    public struct BodyMesh
    {
        public readonly IList<double[]> Vertices;
        public readonly IList<int[]> Triangles;
        public BodyMesh(IList<double[]> vertices, IList<int[]> triangles)
        {
            Vertices = vertices;
            Triangles = triangles;
        }
    }

    /// <summary>Axes and unit of length of an engine, to and from those of the protocol (east, north, up;
    /// metres).</summary>
    /// <example><code>new WorldObject("car", "car", Axes.Unity.PoseToEnu(new Pose(position, orientation)),
    /// …)</code></example>
    public sealed class Axes
    {
        /// <summary>Left-handed centimetres: x east and forward, y south and right, z up.</summary>
        public static readonly Axes Unreal = new Axes(100,
            new double[,] { { 1, 0, 0 }, { 0, -1, 0 }, { 0, 0, 1 } });
        /// <summary>Left-handed metres: x south and right, y up, z east and forward.</summary>
        public static readonly Axes Unity = new Axes(1,
            new double[,] { { 0, -1, 0 }, { 0, 0, 1 }, { 1, 0, 0 } }, null, true);
        /// <summary>Right-handed metres: x south and right, y up, z west and back.</summary>
        public static readonly Axes Godot = new Axes(1,
            new double[,] { { 0, -1, 0 }, { 0, 0, 1 }, { -1, 0, 0 } }, null, true);
        /// <summary>North, east, down; bodies forward, right, down.</summary>
        public static readonly Axes Ned = new Axes(1,
            new double[,] { { 0, 1, 0 }, { 1, 0, 0 }, { 0, 0, -1 } },
            new double[,] { { 1, 0, 0 }, { 0, -1, 0 }, { 0, 0, -1 } });

        private readonly double _unit, _hand;
        private readonly double[,] _world, _body;
        private readonly bool _clockwise;
        private readonly double[] _left, _right;

        /// <summary>Axes of a convention of one's own.</summary>
        /// <param name="unit">Length in the engine of one metre.</param>
        /// <param name="world">Takes a direction in east, north, up to the engine's world axes.</param>
        /// <param name="body">Takes one in forward, left, up to the engine's body axes; null: the
        /// same.</param>
        /// <param name="clockwise">How the engine has the corners of its triangles, as seen from outside.</param>
        public Axes(double unit, double[,] world, double[,] body = null, bool clockwise = false)
        {
            _unit = unit;
            _world = world;
            _body = body ?? world;
            _clockwise = clockwise;
            _hand = Determinant(world);
            // W·R·Bᵀ with W = s·P and B = s·Q, P and Q rotations and s = ±1: the sign cancels.
            _left = QuaternionOf(world, _hand);
            _right = Quaternions.Inverse(QuaternionOf(_body, _hand));
        }

        public Pose PoseToEnu(Pose pose)
        {
            double[] left = Quaternions.Inverse(_left), right = Quaternions.Inverse(_right);
            return new Pose(Back(pose.Position, 1 / _unit), Quaternions.Multiply(left, pose.Orientation, right));
        }

        public Pose PoseFromEnu(Pose pose)
        {
            var turned = Quaternions.Multiply(_left, pose.Orientation, _right);
            return new Pose(Forth(pose.Position, _unit), turned);
        }

        public Motion MotionToEnu(Motion motion)
        {
            return new Motion(Back(motion.Velocity, 1 / _unit), Back(motion.AngularVelocity, _hand));
        }

        public Motion MotionFromEnu(Motion motion)
        {
            return new Motion(Forth(motion.Velocity, _unit), Forth(motion.AngularVelocity, _hand));
        }

        /// <summary>A mesh for OfferMesh, forward, left, up [m] and counter-clockwise as seen from outside, of one
        /// in the engine's body axes, unit and winding: clockwise in Unity and Godot, where the second and third
        /// corner change places; counter-clockwise in Unreal.</summary>
        public BodyMesh MeshToEnu(IList<double[]> vertices, IList<int[]> triangles)
        {
            return new BodyMesh(vertices.Select(vertex => Back(vertex, 1 / _unit, _body)).ToList(),
                triangles.Select(t => _clockwise ? new[] { t[0], t[2], t[1] } : t).ToList());
        }

        private double[] Forth(double[] v, double factor)
        {
            return Enumerable.Range(0, 3)
                .Select(i => factor * (_world[i, 0] * v[0] + _world[i, 1] * v[1] + _world[i, 2] * v[2]) + 0.0)
                .ToArray();
        }

        private double[] Back(double[] v, double factor) { return Back(v, factor, _world); }

        private static double[] Back(double[] v, double factor, double[,] rows)
        {
            return Enumerable.Range(0, 3)
                .Select(i => factor * (rows[0, i] * v[0] + rows[1, i] * v[1] + rows[2, i] * v[2]) + 0.0)
                .ToArray();
        }

        private static double Determinant(double[,] m)
        {
            return m[0, 0] * (m[1, 1] * m[2, 2] - m[1, 2] * m[2, 1])
                - m[0, 1] * (m[1, 0] * m[2, 2] - m[1, 2] * m[2, 0])
                + m[0, 2] * (m[1, 0] * m[2, 1] - m[1, 1] * m[2, 0]);
        }

        // The greatest of the four components is found from the diagonal, the others from it: no small
        // divisor.
        private static double[] QuaternionOf(double[,] matrix, double hand)
        {
            Func<int, int, double> m = (i, j) => hand * matrix[i, j];
            double[] squares = { 1 + m(0, 0) + m(1, 1) + m(2, 2), 1 + m(0, 0) - m(1, 1) - m(2, 2),
                1 - m(0, 0) + m(1, 1) - m(2, 2), 1 - m(0, 0) - m(1, 1) + m(2, 2) };
            double[][] rows =
            {
                new[] { squares[0], m(2, 1) - m(1, 2), m(0, 2) - m(2, 0), m(1, 0) - m(0, 1) },
                new[] { m(2, 1) - m(1, 2), squares[1], m(0, 1) + m(1, 0), m(0, 2) + m(2, 0) },
                new[] { m(0, 2) - m(2, 0), m(0, 1) + m(1, 0), squares[2], m(1, 2) + m(2, 1) },
                new[] { m(1, 0) - m(0, 1), m(0, 2) + m(2, 0), m(1, 2) + m(2, 1), squares[3] },
            };
            int greatest = Array.IndexOf(squares, squares.Max());
            return rows[greatest].Select(part => part / (2 * Math.Sqrt(squares[greatest]))).ToArray();
        }
    }

    /// <summary>Quaternions (w, x, y, z).</summary>
    public static class Quaternions
    {
        public static double[] Multiply(double[] a, double[] b)
        {
            return new[]
            {
                a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
                a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
                a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
                a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
            };
        }

        public static double[] Multiply(double[] a, double[] b, double[] c)
        {
            return Multiply(Multiply(a, b), c);
        }
        public static double[] Inverse(double[] q) { return new[] { q[0], -q[1], -q[2], -q[3] }; }

        /// <summary>Intrinsic z–y′–x″ [rad]: yaw counter-clockwise, then pitch, positive lowers the nose,
        /// then roll.</summary>
        public static double[] FromEuler(double yaw, double pitch = 0, double roll = 0)
        {
            double cy = Math.Cos(yaw / 2), sy = Math.Sin(yaw / 2), cp = Math.Cos(pitch / 2),
                sp = Math.Sin(pitch / 2);
            double cr = Math.Cos(roll / 2), sr = Math.Sin(roll / 2);
            return new[]
            {
                cy * cp * cr + sy * sp * sr, cy * cp * sr - sy * sp * cr,
                cy * sp * cr + sy * cp * sr, sy * cp * cr - cy * sp * sr,
            };
        }
    }

    // --- Scenery -------------------------------------------------------------------------------------------

    /// <summary>A mesh of the static scenery: vertices [m] in world axes, corners of triangles
    /// counter-clockwise from outside.</summary>
    public sealed class SceneryMesh
    {
        public readonly string Name, Material;
        public readonly IList<double[]> Vertices;
        public readonly IList<int[]> Triangles;

        public SceneryMesh(string name, IList<double[]> vertices, IList<int[]> triangles, string material)
        {
            Name = name; Vertices = vertices; Triangles = triangles; Material = material;
        }
    }

    /// <summary>A radio material: a type of Recommendation ITU-R P.2040, and its thickness [m].</summary>
    public sealed class Material
    {
        internal static readonly string[] Types =
        {
            "asphalt_concrete", "brick", "carpet_tile", "ceiling_board", "chipboard", "clear_acrylic", "concrete",
            "floorboard", "glass", "marble", "metal", "plasterboard", "plywood", "vinyl_tile", "wood",
            "very_dry_ground", "medium_dry_ground", "wet_ground", "vacuum",
        };
        public readonly string Name, Type;
        public readonly double Thickness;

        public Material(string name, string type, double thickness = 0.2)
        {
            if (!Types.Contains(type))
                throw new ArgumentException("material '" + name + "': no type is '" + type + "'; one of "
                    + string.Join(", ", Types));
            if (!(thickness > 0))
                throw new ArgumentException("material '" + name + "': a thickness of " + thickness
                    + " m; it has to be above 0");
            Name = name; Type = type; Thickness = thickness;
        }
    }

    /// <summary>A mesh that OfferMesh took, as objects have it.</summary>
    public sealed class OfferedMesh
    {
        /// <summary>For WorldObject.Mesh; empty where it was refused, and its objects are boxes.</summary>
        public readonly string Mesh;
        /// <summary>Sides of its bounding box [m]; middle of that box in the axes of the mesh [m], which is where
        /// the Position of an object is.</summary>
        public readonly double[] Dimensions, Centre;

        public OfferedMesh(string mesh, double[] dimensions, double[] centre)
        {
            Mesh = mesh; Dimensions = dimensions; Centre = centre;
        }
    }

    /// <summary>Files that a world brings, made in memory.</summary>
    internal sealed class Assets
    {
        private readonly SortedDictionary<string, byte[]> _files =
            new SortedDictionary<string, byte[]>(Comparer<string>.Create(Bytes.Compare));
        private readonly Dictionary<string, string> _digests = new Dictionary<string, string>();

        public void Clear() { _files.Clear(); _digests.Clear(); }

        public bool Has(string name) { return _files.ContainsKey(name); }

        public string Offer(string name, byte[] data)
        {
            if (!Schema.IsPath(name))
                throw new ArgumentException("'" + name
                    + "' is no name of an asset; write a relative path such as objects/car.ply");
            _files[name] = data;
            _digests[name] = Bytes.Sha256(data);
            return name;
        }

        public static byte[] Ply(string name, IList<double[]> vertices, IList<int[]> triangles,
            string material = "")
        {
            foreach (var triangle in triangles)
                if (triangle.Length != 3 || triangle.Any(corner => corner < 0 || corner >= vertices.Count))
                    throw new ArgumentException("mesh '" + name + "': the corners "
                        + string.Join(", ", triangle) + " are not three of its " + vertices.Count
                        + " vertices");
            var head = Bytes.Utf8("ply\nformat binary_little_endian 1.0\n"
                + (material == "" ? "" : "comment material " + material + "\n")
                + "element vertex " + vertices.Count + "\nproperty float x\nproperty float y\nproperty float z\nelement face " + triangles.Count
                + "\nproperty list uchar int vertex_indices\nend_header\n");
            var data = new byte[head.Length + 12 * vertices.Count + 13 * triangles.Count];
            head.CopyTo(data, 0);
            int at = head.Length;
            foreach (var vertex in vertices)
                foreach (var coordinate in vertex.Take(3))
                {
                    var four = BitConverter.GetBytes((float)coordinate + 0f);
                    if (!BitConverter.IsLittleEndian) Array.Reverse(four);
                    four.CopyTo(data, at);
                    at += 4;
                }
            foreach (var triangle in triangles)
            {
                data[at++] = 3;
                foreach (var corner in triangle) { Bytes.PutWhole(data, at, 4, corner); at += 4; }
            }
            return data;
        }

        /// <summary>The box around the vertices that are finite; all 0 where there is none.</summary>
        public static OfferedMesh BoxOf(IList<double[]> vertices)
        {
            var finite = vertices.Where(v => v.Take(3).All(x => !double.IsNaN(x) && !double.IsInfinity(x)))
                .DefaultIfEmpty(new double[3]).ToList();
            var low = Enumerable.Range(0, 3).Select(i => finite.Min(v => v[i])).ToArray();
            var high = Enumerable.Range(0, 3).Select(i => finite.Max(v => v[i])).ToArray();
            return new OfferedMesh("", high.Zip(low, (h, l) => h - l).ToArray(),
                high.Zip(low, (h, l) => (h + l) / 2).ToArray());
        }

        /// <summary>Vertices that fill the unit box, as the mesh of an object does.</summary>
        public static List<double[]> InUnitBox(IList<double[]> vertices, OfferedMesh box)
        {
            double[] side = box.Dimensions, centre = box.Centre;
            return vertices.Select(v => Enumerable.Range(0, 3)
                .Select(i => side[i] > 0 ? (v[i] - centre[i]) / side[i] : 0.0).ToArray()).ToList();
        }

        public void OfferScenery(string name, IEnumerable<SceneryMesh> meshes,
            IEnumerable<Material> materials)
        {
            var xml = new StringBuilder("<scene version=\"2.1.0\">\n");
            var known = new HashSet<string>();
            foreach (var material in materials)
            {
                if (!known.Add(material.Name))
                    throw new ArgumentException("material '" + material.Name + "' is there twice");
                xml.Append("  <bsdf type=\"itu-radio-material\" id=\"mat-" + Escaped(material.Name)
                    + "\">\n    <string name=\"type\" value=\"" + material.Type
                    + "\"/>\n    <float name=\"thickness\" value=\""
                    + material.Thickness.ToString("R", CultureInfo.InvariantCulture)
                    + "\"/>\n  </bsdf>\n");
            }
            var names = new HashSet<string>();
            foreach (var mesh in meshes)
            {
                if (!names.Add(mesh.Name))
                    throw new ArgumentException("mesh '" + mesh.Name + "' is there twice");
                if (!known.Contains(mesh.Material))
                    throw new ArgumentException("mesh '" + mesh.Name + "': no material is called '"
                        + mesh.Material + "'");
                Offer("scenery/meshes/" + mesh.Name + ".ply", Ply(mesh.Name, mesh.Vertices, mesh.Triangles));
                xml.Append("  <shape type=\"ply\" id=\"mesh-" + Escaped(mesh.Name)
                    + "\">\n    <string name=\"filename\" value=\"meshes/" + Escaped(mesh.Name)
                    + ".ply\"/>\n    <boolean name=\"face_normals\" value=\"true\"/>\n    <ref id=\"mat-"
                    + Escaped(mesh.Material) + "\" name=\"bsdf\"/>\n  </shape>\n");
            }
            Offer("scenery/" + name + ".xml", Bytes.Utf8(xml.Append("</scene>\n").ToString()));
        }

        private static string Escaped(string text)
        {
            return text.Replace("&", "&amp;").Replace("<", "&lt;").Replace(">", "&gt;")
                .Replace("\"", "&quot;");
        }

        public List<object> Entries()
        {
            return _files.Select(file => (object)new Map { { "name", file.Key },
                { "digest", _digests[file.Key] }, { "size", (long)file.Value.Length } }).ToList();
        }

        public string Geometry()
        {
            var chain = string.Concat(_files.Keys.Select(name => name + "\0" + _digests[name] + "\0"));
            return chain == "" ? "" : Bytes.Sha256(Bytes.Utf8(chain));
        }

        /// <summary>The file of a digest, or null.</summary>
        public byte[] Find(string digest)
        {
            return _files.Where(file => _digests[file.Key] == digest).Select(file => file.Value)
                .FirstOrDefault();
        }
    }

    /// <summary>Meshes that come while an episode goes on, each for as long as an object has it (SPEC.md,
    /// Geometry at run time).</summary>
    internal sealed class RunTimeMeshes
    {
        /// <summary>Frames for which a mesh stays that no object has any more: one that comes back soon costs
        /// nothing.</summary>
        public const int LingerFrames = 20;

        private sealed class File
        {
            public byte[] Data;
            public long Used; // frame in which an object had it last, or in which it came
        }

        private readonly SortedDictionary<string, File> _files =
            new SortedDictionary<string, File>(StringComparer.Ordinal);
        private readonly HashSet<string> _refused = new HashSet<string>();
        private string _announced = ""; // null: not known
        private long _frame; // that is computed next

        /// <summary>Triangles that a mesh may have; 0: the run takes none, and objects are boxes.</summary>
        public long MaxFaces;

        /// <summary>Begin an episode, or go on in it at a frame.</summary>
        /// <param name="again">Whether another process of this world may have announced some before.</param>
        public void Reset(bool again, long frame = 0)
        {
            _files.Clear();
            _announced = again ? null : "";
            _frame = frame;
        }

        /// <summary>Whether a name is that of a mesh that came while a run went on: consumers without that mesh
        /// have a box.</summary>
        public static bool IsName(string name)
        {
            return name.Length == 76 && name.StartsWith("objects/", StringComparison.Ordinal)
                && name.EndsWith(".ply", StringComparison.Ordinal)
                && name.Skip(8).Take(64).All(letter => "0123456789abcdef".IndexOf(letter) >= 0);
        }

        /// <summary>Raises ArgumentException for what a run would refuse.</summary>
        public static void Check(string name, IList<double[]> vertices, IList<int[]> triangles, long maxFaces)
        {
            string who = "mesh '" + name + "': ";
            if (vertices.Any(vertex => vertex.Take(3).Any(x => double.IsNaN(x) || double.IsInfinity(x))))
                throw new ArgumentException(who + "a vertex is not finite");
            if (triangles.Count == 0) throw new ArgumentException(who + "it has no triangle");
            if (maxFaces > 0 && triangles.Count > maxFaces)
                throw new ArgumentException(who + "it has " + triangles.Count
                    + " triangles, and this run takes " + maxFaces);
            if (vertices.Count == 0 || Enumerable.Range(0, 3).Any(i =>
                vertices.Max(vertex => vertex[i]) <= vertices.Min(vertex => vertex[i])))
                throw new ArgumentException(who + "it is flat");
        }

        /// <summary>Bring a mesh; its name.</summary>
        public string Add(byte[] data)
        {
            string name = "objects/" + Bytes.Sha256(data) + ".ply";
            File file;
            if (!_files.TryGetValue(name, out file)) _files[name] = file = new File { Data = data };
            file.Used = Math.Max(file.Used, _frame);
            return name;
        }

        public bool Has(string name) { return _files.ContainsKey(name) && !_refused.Contains(name); }

        /// <summary>What DONE says of the meshes of a frame; null where they are those of the frame
        /// before.</summary>
        public Map Change(long frame, IEnumerable<string> meshes)
        {
            _frame = frame + 1;
            if (MaxFaces == 0) return null;
            File file;
            foreach (var mesh in meshes)
                if (_files.TryGetValue(mesh, out file)) file.Used = frame;
            foreach (var gone in _files.Where(entry => entry.Value.Used + LingerFrames < frame)
                .Select(entry => entry.Key).ToList())
                _files.Remove(gone);
            var names = _files.Keys.Where(Has).ToList();
            var announced = string.Concat(names);
            if (announced == _announced) return null;
            _announced = announced;
            var assets = names.Select(name => (object)new Map { { "name", name },
                { "digest", name.Substring(8, 64) }, { "size", (long)_files[name].Data.Length } });
            return new Map { { "frame", frame }, { "assets", assets.ToList() } };
        }

        /// <summary>The broker takes a mesh for none, or, where the digest is empty, all of them.</summary>
        public void Refuse(string digest)
        {
            _refused.UnionWith(_files.Keys.Where(name => digest == "" || name.Substring(8, 64) == digest));
        }

        /// <summary>The file of a digest, or null.</summary>
        public byte[] Find(string digest)
        {
            File file;
            return _files.TryGetValue("objects/" + digest + ".ply", out file) ? file.Data : null;
        }
    }

    // --- The scene of an instant ---------------------------------------------------------------------------

    /// <summary>An object of a frame: pose and velocity of the middle of its box, in east, north, up and
    /// metres.</summary>
    public sealed class WorldObject
    {
        public string Name, Class, Mesh = "";
        public double[] Position, Orientation = { 1, 0, 0, 0 }, Velocity = { 0, 0, 0 }, Dimensions;
        /// <summary>[rad/s] in world axes; null where the world does not know it.</summary>
        public double[] AngularVelocity;

        public WorldObject(string name, string @class, double[] position, double[] dimensions)
        {
            Name = name; Class = @class; Position = position; Dimensions = dimensions;
        }
    }

    /// <summary>Makes the product of a frame from its objects, and mounts the scenario's devices on
    /// them.</summary>
    public sealed class SceneBuilder
    {
        private const double LightSpeed = 299792458;
        private readonly List<Map> _specs;
        private List<string> _arrived = new List<string>();

        /// <param name="devices">As in <c>scenario.devices</c> of WELCOME.</param>
        public SceneBuilder(IEnumerable<Map> devices) { _specs = devices.ToList(); }

        /// <summary>Prefixes that names of objects have to begin with; empty: any name will do.</summary>
        public readonly List<string> Prefixes = new List<string>();
        /// <summary>Whether a mesh was offered; null: it is not looked at.</summary>
        public Func<string, bool> HasMesh;

        /// <summary>Objects of the last frame, those that came first in front.</summary>
        public IList<string> Arrived { get { return _arrived; } set { _arrived = value.ToList(); } }

        public IEnumerable<string> FixedNames
        {
            get { return _specs.Where(spec => spec.Text("on") == "").Select(spec => spec.Text("name")); }
        }

        /// <summary>The scene of a frame; raises ArgumentException where an object is not what a scene may
        /// hold.</summary>
        public Product Build(IEnumerable<WorldObject> objects)
        {
            var given = objects.ToList();
            foreach (var item in given) Check(item);
            var there = given.OrderBy(item => item.Name, Comparer<string>.Create(Bytes.Compare)).ToList();
            for (int i = 1; i < there.Count; i++)
                if (there[i].Name == there[i - 1].Name)
                    throw new ArgumentException("object '" + there[i].Name
                        + "' is in the frame twice; give each a name of its own");
            var scene = new Map
            {
                { "names", there.Select(item => (object)item.Name).ToList() },
                { "classes", there.Select(item => (object)item.Class).ToList() },
                { "assets", there.Select(item => (object)item.Mesh).ToList() },
                { "position", NdArray.Rows(3, there.Select(item => item.Position).ToList()) },
                { "orientation", NdArray.Rows(4, there.Select(item => item.Orientation).ToList()) },
                { "velocity", NdArray.Rows(3, there.Select(item => item.Velocity).ToList()) },
                { "dimensions", NdArray.Rows(3, there.Select(item => item.Dimensions).ToList()) },
                { "devices", Devices(given) },
            };
            if (there.Any(item => item.AngularVelocity != null))
                scene["angular_velocity"] = NdArray.Rows(3,
                    there.Select(item => item.AngularVelocity ?? new double[3]).ToList());
            return Codec.EncodePayload("scene", scene);
        }

        private void Check(WorldObject item)
        {
            if (string.IsNullOrEmpty(item.Name) || !Schema.IsPrintable(item.Name))
                throw new ArgumentException("an object is called '" + item.Name
                    + "'; a name has printable characters");
            string who = "object '" + item.Name + "': ";
            if (Prefixes.Count > 0 && !Prefixes.Any(prefix =>
                item.Name.StartsWith(prefix, StringComparison.Ordinal)))
                throw new ArgumentException(who + "no prefix of READY begins its name ("
                    + string.Join(", ", Prefixes) + "); add one in Prepare");
            Numbers(who + "position", item.Position, 3, 1e9);
            Numbers(who + "orientation", item.Orientation, 4, 2);
            double norm = Length(item.Orientation);
            if (Math.Abs(norm - 1) > 0.001)
                throw new ArgumentException(who + "the quaternion has the norm " + norm + "; normalise it");
            Numbers(who + "velocity", item.Velocity, 3, LightSpeed);
            Numbers(who + "dimensions", item.Dimensions, 3, 1e5);
            if (item.Dimensions.Any(side => side <= 0))
                throw new ArgumentException(who + "dimensions are " + string.Join(", ", item.Dimensions)
                    + "; each has to be above 0 m");
            if (item.AngularVelocity != null) Numbers(who + "angular velocity", item.AngularVelocity, 3, 1e9);
            double speed = Length(item.Velocity), corners = Length(item.AngularVelocity ?? new double[3])
                * Length(item.Dimensions) / 2;
            if (!(speed + corners < LightSpeed))
                throw new ArgumentException(who + "velocity is " + string.Join(", ", item.Velocity)
                    + ", its corners turn with " + corners + " m/s; together they have to be slower than light");
            if (item.Mesh != "" && HasMesh != null && !HasMesh(item.Mesh))
                throw new ArgumentException(who + "the mesh '" + item.Mesh
                    + "' was not offered; take it from what OfferMesh returns");
        }

        private static double Length(double[] v) { return Math.Sqrt(v.Sum(part => part * part)); }

        private static void Numbers(string what, double[] values, int count, double most)
        {
            if (values == null || values.Length != count || values.Any(value => !(Math.Abs(value) <= most)))
                throw new ArgumentException(what + " is " + (values == null ? "null"
                    : string.Join(", ", values)) + "; it needs " + count + " numbers within ±" + most);
        }

        private List<object> Devices(List<WorldObject> given)
        {
            var there = given.ToDictionary(item => item.Name);
            var known = new HashSet<string>(_arrived);
            _arrived = _arrived.Where(there.ContainsKey).Concat(given.Select(item => item.Name)
                .Where(name => !known.Contains(name))).ToList();
            var found = new List<Map>();
            foreach (var spec in _specs)
                if (spec.Text("on") == "") found.Add(Device(spec, null));
                else found.AddRange(_arrived.Where(name => Matches(spec.Text("on"), name))
                    .Take((int)spec.Whole("count")).Select(name => Device(spec, there[name])));
            return found.OrderBy(device => device.Text("name"), Comparer<string>.Create(Bytes.Compare))
                .Cast<object>().ToList();
        }

        private static double Radians(double degrees) { return degrees * (Math.PI / 180); }

        private static Map Device(Map spec, WorldObject parent)
        {
            var turned = Quaternions.FromEuler(Radians(spec.Number("yaw_deg")),
                Radians(spec.Number("pitch_deg")), Radians(spec.Number("roll_deg")));
            var position = spec.Numbers("position_m");
            var made = new Map { { "type", spec.Text("kind") }, { "name", spec.Text("name") } };
            if (parent != null)
            {
                made["name"] = parent.Name + "/" + spec.Text("name");
                made["parent"] = parent.Name;
                position[2] += spec.Text("mount") == "roof" ? parent.Dimensions[2] / 2
                    : spec.Text("mount") == "floor" ? -parent.Dimensions[2] / 2 : 0;
                object keeps;
                if (spec.TryGetValue("keeps_heading", out keeps) && (bool)keeps)
                    turned = Quaternions.Multiply(Quaternions.Inverse(parent.Orientation), turned);
            }
            made["position"] = position;
            made["orientation"] = turned;
            if (spec.Text("kind") == "antenna")
            {
                made["role"] = spec["role"];
                made["power_dbm"] = spec["power_dbm"];
                object carriers; // a broker of an earlier version does not send them
                if (spec.TryGetValue("carriers", out carriers)) made["carriers"] = carriers;
                if (spec["array"] != null) made["array"] = ArrayOf(spec.Child("array"));
            }
            else if (spec.Text("kind") == "lidar")
            {
                double[] elevation = spec.Numbers("elevation_deg"), range = spec.Numbers("range_m");
                made["beams"] = spec["beams"];
                made["azimuth_steps"] = spec["azimuth_steps"];
                made["elevation_min"] = Radians(elevation[0]);
                made["elevation_max"] = Radians(elevation[1]);
                made["min_range"] = range[0];
                made["max_range"] = range[1];
            }
            else
            {
                made["width"] = spec.List("size_px")[0];
                made["height"] = spec.List("size_px")[1];
                made["field_of_view"] = Radians(spec.Number("field_of_view_deg"));
            }
            return made;
        }

        private static Map ArrayOf(Map given)
        {
            var array = new Map();
            foreach (var pair in given) array[pair.Key] = pair.Value;
            // A path on the broker's machine here, the name of an asset in a scene.
            if (given.Text("pattern_file") != "")
                array["pattern_file"] = "patterns/" + given.Text("pattern_file").Split('/').Last();
            return array;
        }

        /// <summary>Whether a name matches <c>on</c> of a device: the name itself, or a pattern with * ?
        /// [abc] [!abc].</summary>
        public static bool Matches(string pattern, string name)
        {
            return pattern == name || Matches(pattern, 0, name, 0);
        }

        private static bool Matches(string pattern, int p, string name, int n)
        {
            for (; p < pattern.Length; p++, n++)
            {
                if (pattern[p] == '*')
                    return Enumerable.Range(n, name.Length - n + 1)
                        .Any(from => Matches(pattern, p + 1, name, from));
                if (n >= name.Length) return false;
                int close = pattern[p] == '[' ? pattern.IndexOf(']',
                    Math.Min(pattern.Length, p + (p + 1 < pattern.Length && pattern[p + 1] == '!' ? 3 : 2)))
                    : -1;
                if (close >= 0)
                {
                    if (!InSet(pattern.Substring(p + 1, close - p - 1), name[n])) return false;
                    p = close;
                }
                else if (pattern[p] != '?' && pattern[p] != name[n]) return false;
            }
            return n == name.Length;
        }

        private static bool InSet(string set, char character)
        {
            bool inverted = set[0] == '!', found = false;
            for (int i = inverted ? 1 : 0; i < set.Length; i++)
                if (i + 2 < set.Length && set[i + 1] == '-')
                {
                    found |= set[i] <= character && character <= set[i + 2];
                    i += 2;
                }
                else found |= set[i] == character;
            return found != inverted;
        }
    }

    // --- What others made ----------------------------------------------------------------------------------

    /// <summary>A command of an agent, of the frame before.</summary>
    public sealed class Command
    {
        /// <summary><c>beam</c>, <c>waypoint</c>, <c>velocity</c> or <c>schedule</c>.</summary>
        public string Type;
        /// <summary>Object of a waypoint or velocity; its position [m] and greatest speed [m/s], or velocity
        /// [m/s].</summary>
        public string Object = "";
        public double[] Position, Velocity;
        public double Speed;
        public bool AtOnce;
        /// <summary>Ends of a beam choice or schedule; indices into their codebooks.</summary>
        public string Tx = "", Rx = "", Carrier = "";
        public long TxBeam, RxBeam;

        /// <summary>The commands of a decoded product of <c>action</c>.</summary>
        public static List<Command> All(Map action)
        {
            return action.List("commands").Cast<Map>().Select(map => new Command
            {
                Type = map.Text("type"), Object = map.Text("object"), Tx = map.Text("tx"),
                Rx = map.Text("rx"), Carrier = map.Text("carrier"),
                Position = map.ContainsKey("position") ? map.Numbers("position") : null,
                Velocity = map.ContainsKey("velocity") ? map.Numbers("velocity") : null,
                Speed = map.ContainsKey("speed") ? map.Number("speed") : 0,
                AtOnce = map.ContainsKey("at_once") && map.Flag("at_once"),
                TxBeam = map.ContainsKey("tx_beam") ? map.Whole("tx_beam") : 0,
                RxBeam = map.ContainsKey("rx_beam") ? map.Whole("rx_beam") : 0,
            }).ToList();
        }
    }

    /// <summary>What the link achieved for one user: a transmitter, a receiver and a carrier.</summary>
    public sealed class LinkUser
    {
        public string Tx, Rx, Carrier;
        public bool HasPath, Los;
        public long TxBeam, RxBeam;
        public double AbsY, Snr, SpectralEfficiency, BitRate, Reward;

        /// <summary>The users of a decoded product of <c>link</c>; its other fields are in the Map.</summary>
        public static List<LinkUser> All(Map link)
        {
            Func<string, double[]> numbers = name => link.Array(name).ToDoubles();
            double[] path = numbers("has_path"), los = numbers("los"), y = numbers("abs_y"),
                snr = numbers("snr");
            double[] efficiency = numbers("spectral_efficiency"), rate = numbers("bit_rate"),
                reward = numbers("reward");
            long[] txBeam = link.Array("tx_beam").ToLongs(), rxBeam = link.Array("rx_beam").ToLongs();
            string[] tx = link.Texts("tx"), rx = link.Texts("rx"), carrier = link.Texts("carrier");
            return tx.Select((_, i) => new LinkUser
            {
                Tx = tx[i], Rx = rx[i], Carrier = carrier[i], HasPath = path[i] != 0, Los = los[i] != 0,
                TxBeam = txBeam[i], RxBeam = rxBeam[i],
                AbsY = y[i], Snr = snr[i], SpectralEfficiency = efficiency[i], BitRate = rate[i],
                Reward = reward[i],
            }).ToList();
        }
    }

    /// <summary>One path of a channel: delay [s], directions (zenith, azimuth) [rad], and per carrier its
    /// amplitude and Doppler shift [Hz].</summary>
    public sealed class ChannelPath
    {
        public string Tx, Rx;
        public double Tau;
        public double[] Aod, Aoa;
        /// <summary>For each carrier the real part, the imaginary part and the Doppler shift.</summary>
        public double[] Real, Imaginary, Doppler;
        /// <summary>1 reflection, 2 diffraction, 3 scattering, 4 transmission, from TX to RX; and where
        /// [m].</summary>
        public long[] Interactions;
        public double[][] Points;

        /// <summary>The paths of a decoded product of <c>channel</c>, pair by pair; matrices are in the
        /// Map.</summary>
        public static List<ChannelPath> All(Map channel)
        {
            string[] tx = channel.Texts("tx"), rx = channel.Texts("rx");
            long[] offsets = channel.Array("offsets").ToLongs(),
                kinds = channel.Array("interactions").ToLongs();
            double[] a = channel.Array("a").ToDoubles(), tau = channel.Array("tau").ToDoubles(),
                doppler = channel.Array("doppler").ToDoubles();
            double[] aod = channel.Array("aod").ToDoubles(), aoa = channel.Array("aoa").ToDoubles(),
                points = channel.Array("points").ToDoubles();
            int paths = tau.Length, carriers = channel.List("carriers").Count,
                depth = channel.Array("interactions").Shape[1];
            var found = new List<ChannelPath>();
            for (int pair = 0; pair < tx.Length * rx.Length; pair++)
                for (int p = (int)offsets[pair]; p < offsets[pair + 1]; p++)
                {
                    int path = p;
                    var met = Enumerable.Range(path * depth, depth).Where(i => kinds[i] != 0).ToArray();
                    found.Add(new ChannelPath
                    {
                        Tx = tx[pair / rx.Length], Rx = rx[pair % rx.Length], Tau = tau[path],
                        Aod = new[] { aod[2 * path], aod[2 * path + 1] },
                        Aoa = new[] { aoa[2 * path], aoa[2 * path + 1] },
                        Real = Enumerable.Range(0, carriers).Select(c => a[2 * (c * paths + path)]).ToArray(),
                        Imaginary = Enumerable.Range(0, carriers)
                            .Select(c => a[2 * (c * paths + path) + 1]).ToArray(),
                        Doppler = Enumerable.Range(0, carriers)
                            .Select(c => doppler[c * paths + path]).ToArray(),
                        Interactions = met.Select(i => kinds[i]).ToArray(),
                        Points = met.Select(i => new[] { points[3 * i], points[3 * i + 1],
                            points[3 * i + 2] }).ToArray(),
                    });
                }
            return found;
        }
    }

    // --- Connections ---------------------------------------------------------------------------------------

    /// <summary>One WebSocket with threads of its own: nothing here ever blocks the caller.</summary>
    internal sealed class Wire
    {
        private const int RetryMs = 500, ClosingMs = 1000, HandshakeMs = 10000;
        private readonly ConcurrentQueue<byte[]> _inbox = new ConcurrentQueue<byte[]>();
        private readonly BlockingCollection<byte[]> _outbox = new BlockingCollection<byte[]>();
        private readonly CancellationTokenSource _abort = new CancellationTokenSource();
        private readonly AutoResetEvent _arrived;
        private readonly Thread _sender, _receiver;
        private ClientWebSocket _socket;
        private volatile bool _over;

        /// <param name="arrived">Set when a message came, or the connection ended.</param>
        public Wire(Uri endpoint, string token, double patience, AutoResetEvent arrived)
        {
            _arrived = arrived;
            _sender = new Thread(Send) { IsBackground = true, Name = "caviar-send" };
            _receiver = new Thread(() => Live(endpoint, token, patience)) { IsBackground = true,
                Name = "caviar-receive" };
            _receiver.Start();
        }

        /// <summary>Why the connection ended.</summary>
        public volatile string Problem = "";

        public bool Over { get { return _over && _inbox.IsEmpty; } }

        public bool TryReceive(out byte[] frame) { return _inbox.TryDequeue(out frame); }

        public void Send(byte[] frame) { if (!_outbox.IsAddingCompleted) _outbox.Add(frame); }

        /// <summary>Send what is left, say goodbye, and end within a second, or two where the gateway's
        /// goodbye is waited for.</summary>
        public void Close(bool awaitsGoodbye)
        {
            _outbox.CompleteAdding();
            if (!_sender.ThreadState.HasFlag(ThreadState.Unstarted))
            {
                _sender.Join(ClosingMs);
                if (awaitsGoodbye) _receiver.Join(ClosingMs);
            }
            Abort();
        }

        public void Abort()
        {
            _over = true;
            _outbox.CompleteAdding();
            _abort.Cancel();
        }

        private void Live(Uri endpoint, string token, double patience)
        {
            try
            {
                Connect(endpoint, token, patience);
                _sender.Start();
                Receive();
            }
            catch (Exception problem)
            {
                var cause = problem is AggregateException ? problem.GetBaseException() : problem;
                if (Problem == "") Problem = cause.Message;
            }
            _over = true;
            _outbox.CompleteAdding();
            _arrived.Set();
        }

        private void Connect(Uri endpoint, string token, double patience)
        {
            // The gateway may listen seconds after the broker started: until then connections are refused.
            var until = DateTime.UtcNow.AddSeconds(patience);
            while (true)
            {
                _socket = new ClientWebSocket();
                _socket.Options.KeepAliveInterval = Timeout.InfiniteTimeSpan;
                if (!string.IsNullOrEmpty(token))
                    _socket.Options.SetRequestHeader("Authorization", "Bearer " + token);
                try
                {
                    // Without a limit a handshake that a busy gateway lost would be waited for until the end.
                    if (!_socket.ConnectAsync(endpoint, _abort.Token).Wait(HandshakeMs))
                        throw new TimeoutException("no answer to the handshake within " + HandshakeMs + " ms");
                    return;
                }
                catch (Exception problem)
                {
                    _socket.Dispose();
                    if (_abort.IsCancellationRequested || DateTime.UtcNow > until)
                        throw new IOException("cannot reach " + endpoint + ": "
                            + problem.GetBaseException().Message);
                    _abort.Token.WaitHandle.WaitOne(RetryMs);
                }
            }
        }

        private void Receive()
        {
            var piece = new ArraySegment<byte>(new byte[1 << 16]);
            var message = new MemoryStream();
            while (true)
            {
                var got = _socket.ReceiveAsync(piece, _abort.Token).GetAwaiter().GetResult();
                if (got.MessageType == WebSocketMessageType.Close)
                {
                    Problem = "the gateway closed the connection, code " + (int)(got.CloseStatus ?? 0) + " "
                        + got.CloseStatusDescription;
                    return;
                }
                message.Write(piece.Array, 0, got.Count);
                if (!got.EndOfMessage) continue;
                _inbox.Enqueue(message.ToArray());
                message.SetLength(0);
                _arrived.Set();
            }
        }

        private void Send()
        {
            try
            {
                foreach (var frame in _outbox.GetConsumingEnumerable())
                    _socket.SendAsync(new ArraySegment<byte>(frame), WebSocketMessageType.Binary, true,
                        _abort.Token).GetAwaiter().GetResult();
                _socket.CloseOutputAsync(WebSocketCloseStatus.NormalClosure, "",
                    _abort.Token).GetAwaiter().GetResult();
            }
            catch (Exception problem)
            {
                if (Problem == "") Problem = problem.GetBaseException().Message;
            }
        }
    }

    /// <summary>The heartbeat connection: a thread that goes on while a frame is computed.</summary>
    internal sealed class Heart
    {
        private readonly ManualResetEvent _stop = new ManualResetEvent(false);
        private readonly Thread _thread;
        private long _progress;

        /// <summary>Why the broker counts as lost; empty while it answers.</summary>
        public volatile string Lost = "";
        public volatile string Phase = "";

        public Heart(Uri endpoint, string token, Map welcome, string name)
        {
            _thread = new Thread(() => Beat(endpoint, token, welcome, name)) { IsBackground = true,
            Name = "caviar-heart" };
            _thread.Start();
        }

        public void Progress() { Interlocked.Increment(ref _progress); }

        public void Stop()
        {
            _stop.Set();
            _thread.Join(2000);
        }

        private void Beat(Uri endpoint, string token, Map welcome, string name)
        {
            int period = (int)Math.Max(1, welcome.Whole("heartbeat_ns") / 1000000);
            var liveness = TimeSpan.FromMilliseconds(welcome.Whole("liveness_ns") / 1e6);
            var wire = new Wire(endpoint, token, liveness.TotalSeconds, new AutoResetEvent(false));
            wire.Send(Codec.Join(Codec.EncodeMessage("ATTACH",
                new Map { { "epoch", welcome["epoch"] }, { "attempt", welcome["attempt"] },
                { "name", name } })));
            var heard = DateTime.UtcNow;
            for (long sequence = 0; Lost == ""; sequence++)
            {
                if (_stop.WaitOne(period)) break;
                byte[] frame;
                while (wire.TryReceive(out frame))
                {
                    heard = DateTime.UtcNow;
                    string refusal = RefusalIn(frame);
                    if (refusal != "") Lost = refusal;
                }
                if (wire.Over) Lost = "the heartbeat connection is lost: " + wire.Problem;
                else if (DateTime.UtcNow - heard > liveness)
                    Lost = "the broker is silent, for " + liveness.TotalSeconds.ToString(
                        CultureInfo.InvariantCulture) + " s";
                else wire.Send(Codec.Join(Codec.EncodeMessage("HEARTBEAT",
                    new Map { { "sequence", sequence }, { "progress", Interlocked.Read(ref _progress) },
                    { "phase", Phase } })));
            }
            if (Lost == "") wire.Close(false);
            else wire.Abort();
        }

        private static string RefusalIn(byte[] frame)
        {
            try
            {
                var message = Codec.DecodeMessage(Codec.Split(frame)[0]);
                return message.Text("type") == "ERROR" || message.Text("type") == "REFUSE"
                    ? message.Text("code") + ": " + message.Text("message") : "";
            }
            catch (ProtocolException) { return ""; } // noise: the next heartbeat asks again
        }
    }

    // --- The world -----------------------------------------------------------------------------------------

    /// <summary>A world of a run: derive from it, override Step, and call Poll once a tick.</summary>
    public abstract class World
    {
        private enum State { Connecting, Joined, Preparing, Ready, Active, Over }

        private static readonly byte[] StateMark = Bytes.Utf8("caviar-world-1\n");
        private const double SmallestM = 0.01; // side of the box of a mesh that is refused and has none
        private const int DigestedBytes = 16 << 10, PoolRestMs = 200;
        private readonly AutoResetEvent _arrived = new AutoResetEvent(false);
        private readonly Assets _assets = new Assets();
        private readonly RunTimeMeshes _meshes = new RunTimeMeshes();
        private readonly HashSet<string> _said = new HashSet<string>();
        private readonly Queue<KeyValuePair<Map, List<byte[]>>> _grants = new Queue<KeyValuePair<Map,
            List<byte[]>>>();
        private readonly Dictionary<long, byte[]> _answers = new Dictionary<long, byte[]>();
        private readonly Dictionary<string, List<Map>> _products = new Dictionary<string, List<Map>>();
        private Uri _endpoint;
        private string _token;
        private Wire _wire;
        private Heart _heart;
        private SceneBuilder _scene;
        private State _state = State.Over;
        private bool _faulted;
        private DateTime _deadline, _rejoinUntil = DateTime.MinValue, _retryAt;
        private double _pause;
        private long _rejoinNs, _epoch, _attempt, _episode, _t0, _previous, _newest;
        private bool _stepped;

        /// <summary>A topic that the world wants to see: <c>action</c>, <c>link</c>, <c>channel</c>,
        /// …</summary>
        protected struct Input
        {
            public string Topic;
            public string[] Parts;
        }

        // --- what a world overrides ------------------------------------------------------------------------

        /// <summary>Load, offer meshes and scenery, and add to Prefixes; Settings and Scenario are
        /// there.</summary>
        protected virtual void Prepare() { }

        /// <summary>Go to the first state. Everything random follows from the seed, SeedEpisode and the
        /// frame.</summary>
        /// <param name="t0">Time of frame 0 in the run [s]; Step counts from it.</param>
        protected virtual void Reset(long seed, double t0) { }

        /// <summary>The objects at an instant; null: not yet, ask again at the next Poll.</summary>
        /// <param name="t">Time since frame 0 of the episode [s].</param>
        /// <param name="previous">Time of the frame completed last; t itself for the first one.</param>
        /// <param name="commands">Of agents in the frame before, where Listen("action") was called.</param>
        protected abstract IEnumerable<WorldObject> Step(double t, double previous, IList<Command> commands);

        /// <summary>The state after the last frame; empty where frames follow from time, seed and settings
        /// alone.</summary>
        protected virtual byte[] Save() { return new byte[0]; }

        /// <summary>Take over what Save returned.</summary>
        protected virtual void Restore(byte[] state) { }

        // --- what a world may use --------------------------------------------------------------------------

        public string Name { get; private set; }
        /// <summary>Of the world, from the scenario; and what concerns all services.</summary>
        public Map Settings { get; private set; }
        public Map Scenario { get; private set; }
        /// <summary>Prefixes of the names of objects; those of fixed devices are added by
        /// themselves.</summary>
        public readonly List<string> Prefixes = new List<string>();
        public long Frame { get; private set; }
        public long Episode { get { return _episode; } }
        public long SeedEpisode { get; private set; }
        /// <summary>Shown with HELLO: what the world is.</summary>
        public string Implementation = "caviar-csharp";
        /// <summary>How long to wait for WELCOME [s].</summary>
        public double Patience = 120;
        /// <summary>Takes lines for people; by default the standard error output.</summary>
        public Action<string> Log = line => Console.Error.WriteLine(line);
        public bool IsOver { get { return _state == State.Over; } }
        public int ExitStatus { get; private set; }
        public string EndReason { get; private set; }

        private readonly List<Input> _inputs = new List<Input>();

        /// <summary>Ask for a topic, of the frame before, before Connect; the run does not wait for
        /// it.</summary>
        public void Listen(string topic, params string[] parts)
        {
            _inputs.Add(new Input { Topic = topic, Parts = parts });
        }

        /// <summary>Decoded products of a topic in this frame, one for each source that has one.</summary>
        public IList<Map> Products(string topic)
        {
            List<Map> found;
            return _products.TryGetValue(topic, out found) ? found : new List<Map>();
        }

        /// <summary>Bring the mesh of objects: what they have as Mesh and Dimensions. In Prepare it is there for the whole run. In Reset, Step and Restore it comes while the run goes on, and stays as long
        /// as an object has it, and 20 frames longer, until the episode ends; a state has no meshes, so that
        /// Restore offers those of its objects again. One that is none is logged then, and its Mesh is empty:
        /// its objects are boxes, of at least 1 cm.</summary>
        /// <param name="vertices">In body axes (x forward, y left, z up) [m]; they are fitted into the unit box
        /// that Dimensions scale.</param>
        /// <param name="material">Of Recommendation ITU-R P.2040; empty: what the channel's settings
        /// say.</param>
        public OfferedMesh OfferMesh(string name, IList<double[]> vertices, IList<int[]> triangles,
            string material = "")
        {
            bool runs = _state == State.Ready || _state == State.Active;
            var box = Assets.BoxOf(vertices);
            try
            {
                if (material != "" && !Material.Types.Contains(material))
                    throw new ArgumentException("mesh '" + name + "': no type is '" + material + "'; one of "
                        + string.Join(", ", Material.Types));
                if (runs) RunTimeMeshes.Check(name, vertices, triangles, _meshes.MaxFaces);
                var file = Assets.Ply(name, Assets.InUnitBox(vertices, box), triangles, material);
                string mesh = runs ? _meshes.Add(file) : _assets.Offer("objects/" + name + ".ply", file);
                return new OfferedMesh(mesh, box.Dimensions, box.Centre);
            }
            catch (ArgumentException problem)
            {
                if (!runs) throw;
                LogOnce(problem.Message + "; objects with it are boxes");
                return new OfferedMesh("", box.Dimensions.Select(side => Math.Max(side, SmallestM)).ToArray(),
                    box.Centre);
            }
        }

        private void LogOnce(string line)
        {
            if (_said.Add(line)) Log(Name + ": " + line);
        }

        /// <summary>A mesh as the run may have it.</summary>
        private string Looked(string mesh)
        {
            if (!RunTimeMeshes.IsName(mesh)) return mesh;
            if (_meshes.MaxFaces == 0) return ""; // the run takes no meshes now
            if (!_meshes.Has(mesh))
                LogOnce(mesh + " is not there; objects with it are boxes until OfferMesh brings it");
            return mesh;
        }

        /// <summary>Bring the static scenery: a mesh of a material each.</summary>
        public void OfferScenery(IEnumerable<SceneryMesh> meshes, IEnumerable<Material> materials,
            string name = "world")
        {
            _assets.OfferScenery(name, meshes, materials);
        }

        /// <summary>Bring any other file, such as <c>patterns/NAME.csv</c>.</summary>
        public string OfferFile(string name, byte[] data) { return _assets.Offer(name, data); }

        // --- life ------------------------------------------------------------------------------------------

        /// <summary>Begin to join the run; returns at once.</summary>
        /// <param name="endpoint"><c>ws://HOST:PORT/ws</c>, the gateway of <c>caviar run --http</c>.</param>
        /// <param name="token">Of the service, where the broker has tokens.</param>
        public void Connect(string endpoint, string name, string token = null)
        {
            if (_state != State.Over)
                throw new InvalidOperationException("the world '" + Name + "' takes part in a run already");
            _token = token;
            Name = name;
            ExitStatus = 0;
            _faulted = false;
            EndReason = "";
            if (Uri.TryCreate(endpoint, UriKind.Absolute, out _endpoint)
            && (_endpoint.Scheme == "ws" || _endpoint.Scheme == "wss"))
                Join(Patience);
            else
                End(1, "'" + endpoint + "' is no address of a gateway; write ws://HOST:PORT/ws");
        }

        /// <summary>Handle what came, at most one frame; false once the world has left. Never
        /// waits.</summary>
        public bool Poll()
        {
            if (_state == State.Over) return false;
            if (_wire == null)
            {
                if (DateTime.UtcNow >= _retryAt) Join(5);
                return true;
            }
            byte[] frame;
            while (_state != State.Over && _wire != null && _grants.Count == 0 && _wire.TryReceive(out frame))
                Receive(frame);
            if (_state == State.Over || _wire == null) return _state != State.Over;
            if (_grants.Count > 0) Answer();
            else if (_wire.Over) Lose(_wire.Problem);
            else if (_state == State.Connecting && DateTime.UtcNow > _deadline) Lose("no WELCOME");
            else if (_heart != null && _heart.Lost != "") Lose(_heart.Lost);
            return _state != State.Over;
        }

        /// <summary>Poll until the world has left, for programs without a loop of their own; the exit
        /// status.</summary>
        public int Run(string endpoint, string name, string token = null)
        {
            Connect(endpoint, name, token);
            var terminated = Termination.Watch();
            while (Poll())
            {
                if (terminated.IsSet) Leave(143, "SIGTERM");
                else if (_grants.Count == 0) _arrived.WaitOne(20);
            }
            // At its end Mono 6.8 aborts the threads of its pool and waits for them. One that is aborted on its
            // way to rest does not notice, and holds the program for 5 to 60 s: 25 of 1,000 ends without this.
            if (Type.GetType("Mono.Runtime") != null) Thread.Sleep(PoolRestMs);
            return ExitStatus;
        }

        /// <summary>Leave the run: call it where the engine closes. The run may wait for the world to come
        /// back.</summary>
        public void Close() { if (_state != State.Over) Leave(0, "closed"); }

        private void Join(double patience)
        {
            _state = State.Connecting;
            _grants.Clear();
            _deadline = DateTime.UtcNow.AddSeconds(patience);
            _wire = new Wire(_endpoint, _token, patience, _arrived);
            var inputs = _inputs.Select(input => (object)new Map
            {
                { "topic", input.Topic }, { "lag", 1L }, { "required", false },
                { "parts", input.Parts.Cast<object>().ToList() },
            }).ToList();
            Send("HELLO", new Map
            {
                { "version", new List<object> { 1L, 6L } }, { "name", Name }, { "role", "world" },
                { "inputs", inputs },
                { "outputs", new List<object> { "scene" } },
                { "capabilities", new List<object> { "assets", "episodes", "checkpoint",
                    "geometry" } },
                { "implementation", Implementation }, { "max_in_flight", 4L },
            });
        }

        /// <summary>The connection or the broker is lost: come back within the time that WELCOME gave, or
        /// end.</summary>
        private void Lose(string why)
        {
            if (_state != State.Connecting) _rejoinUntil = DateTime.UtcNow.AddMilliseconds(_rejoinNs / 1e6);
            bool first = _epoch == 0;
            Disconnect();
            if (first || DateTime.UtcNow >= _rejoinUntil) { End(1, why); return; }
            if (_state != State.Connecting)
            {
                Log(Name + ": " + why + "; trying to come back");
                _pause = 0.1;
            }
            _state = State.Connecting;
            _pause = Math.Min(1, 2 * _pause);
            _retryAt = DateTime.UtcNow.AddSeconds(_pause);
        }

        private void Disconnect()
        {
            if (_heart != null) _heart.Stop();
            if (_wire != null) _wire.Abort();
            _heart = null;
            _wire = null;
        }

        private void Leave(int status, string reason)
        {
            if (_heart != null) _heart.Stop();
            _heart = null;
            if (_wire != null && _epoch > 0 && _state != State.Connecting)
                Send("BYE", With(new Map { { "reason", reason } }));
            if (_wire != null) _wire.Close(true);
            _wire = null;
            End(status, reason);
        }

        private void End(int status, string reason)
        {
            _state = State.Over;
            _epoch = 0;
            ExitStatus = status == 0 && _faulted ? 1 : status;
            EndReason = reason;
            Log(Name + ": " + reason);
        }

        private void Send(string type, Map fields, params byte[][] parts)
        {
            _wire.Send(Framed(type, fields, parts));
        }

        private static byte[] Framed(string type, Map fields, params byte[][] parts)
        {
            return Codec.Join(new[] { Codec.EncodeMessage(type, fields) }.Concat(parts).ToArray());
        }

        private void Error(string code, string message, string of = "", string subject = "")
        {
            Send("ERROR", new Map { { "code", code }, { "message", message }, { "of", of },
                { "subject", subject } });
        }

        private Map With(Map fields)
        {
            fields["epoch"] = _epoch;
            fields["attempt"] = _attempt;
            return fields;
        }

        private bool IsMine(Map message)
        {
            return message.Whole("epoch") == _epoch && message.Whole("attempt") == _attempt;
        }

        // --- messages --------------------------------------------------------------------------------------

        private void Receive(byte[] frame)
        {
            Map message;
            List<byte[]> parts;
            try
            {
                parts = Codec.Split(frame);
                message = Codec.DecodeMessage(parts[0]);
                Codec.CheckParts(message, parts);
            }
            catch (ProtocolException problem)
            {
                if (problem.Code == "version") { Disconnect(); End(1, problem.Message); }
                else Error(problem.Code, problem.Message);
                return;
            }
            string type = message.Text("type");
            if (_heart != null) _heart.Progress();
            if (type == "SHUTDOWN" && _state != State.Connecting)
            {
                // A reason that blames a service begins with its role and name.
                string reason = message.Text("reason");
                Leave(reason.StartsWith("world '" + Name + "' ", StringComparison.Ordinal) ? 1 : 0, reason);
                return;
            }
            if (type == "REFUSE" && _state == State.Connecting) { Refused(message); return; }
            if (type == "STALE" || type == "ERROR")
            {
                Log(Name + ": " + type + " " + message.Text("code") + message.Text("of") + " "
                    + message.Text("message"));
                if (message.Text("code") == "refused-mesh") _meshes.Refuse(message.Text("subject"));
                return;
            }
            if (type == "CANCEL") return; // advice: the answer is due all the same
            if (type == "ASSET_GET" && _state > State.Joined) { Serve(message); return; }
            bool due = type == "WELCOME" ? _state == State.Connecting : IsDue(type, message);
            if (!due) { Error("unexpected", "this " + type + " is not due", type); return; }
            try { Handle(type, message, parts); }
            catch (Exception problem) { Fault(-1, type.ToLowerInvariant(), problem, ""); }
        }

        private bool IsDue(string type, Map message)
        {
            switch (type)
            {
                case "PREPARE": return _state == State.Joined && IsMine(message);
                case "RESET": return (_state == State.Ready || _state == State.Active) && IsMine(message);
                case "GRANT": case "CHECKPOINT": case "EPISODE_END": case "RESTORE":
                    return _state == State.Active && IsMine(message) && message.Whole("episode") == _episode;
                default: return false;
            }
        }

        private void Handle(string type, Map message, List<byte[]> parts)
        {
            switch (type)
            {
                case "WELCOME": Welcome(message); break;
                case "PREPARE": OnPrepare(message); break;
                case "RESET": OnReset(message); break;
                case "GRANT": _grants.Enqueue(new KeyValuePair<Map, List<byte[]>>(message, parts)); break;
                case "EPISODE_END": _state = State.Ready; break;
                case "CHECKPOINT": Send("CHECKPOINT_DONE", With(new Map { { "episode", _episode },
                    { "frame", message["frame"] } }), Saved()); break;
                case "RESTORE": Restored(parts[1]); Send("READY", With(new Map())); break;
            }
        }

        private void Refused(Map message)
        {
            string why = message.Text("code") + ": " + message.Text("message");
            // Coming back: the broker may not know yet that the connection before is gone.
            if (_epoch > 0 && message.Text("code") == "name-taken") { Lose(why); return; }
            Disconnect();
            End(1, why);
        }

        private void Welcome(Map message)
        {
            _epoch = message.Whole("epoch");
            _attempt = message.Whole("attempt");
            _rejoinNs = message.Whole("rejoin_ns");
            Settings = message.Child("settings");
            Scenario = message.Child("scenario");
            object devices;
            Scenario.TryGetValue("devices", out devices);
            _scene = new SceneBuilder(((List<object>)devices ?? new List<object>())
                .Cast<Map>()) { HasMesh = name => _assets.Has(name) || RunTimeMeshes.IsName(name) };
            _heart = new Heart(_endpoint, _token, message, Name);
            _state = State.Joined;
        }

        private void OnPrepare(Map message)
        {
            _meshes.MaxFaces = message.Whole("max_faces");
            _state = State.Preparing;
            _heart.Phase = "prepare";
            _assets.Clear();
            Prefixes.Clear();
            Prepare();
            foreach (var prefix in Prefixes.Concat(_scene.FixedNames).Distinct()
                .OrderBy(text => text, Comparer<string>.Create(Bytes.Compare)))
                _scene.Prefixes.Add(prefix);
            if (_assets.Entries().Count > 0)
                Send("ASSET_OFFER", With(new Map { { "assets", _assets.Entries() } }));
            Send("READY", With(new Map { { "geometry", _assets.Geometry() },
                { "prefixes", _scene.Prefixes } }));
            _state = State.Ready;
        }

        private void Serve(Map get)
        {
            byte[] data = _assets.Find(get.Text("digest")) ?? _meshes.Find(get.Text("digest"));
            long offset = get.Whole("offset");
            if (data == null || offset > data.Length)
            {
                Error("unknown-asset", "no asset has this digest, or it ends before", "ASSET_GET",
                    get.Text("digest"));
                return;
            }
            var piece = new byte[Math.Min(Codec.MaxAssetChunk, data.Length - offset)];
            Buffer.BlockCopy(data, (int)offset, piece, 0, piece.Length);
            Send("ASSET_DATA", new Map { { "digest", get["digest"] }, { "offset", offset },
                { "size", (long)data.Length } }, piece);
        }

        private void OnReset(Map message)
        {
            _episode = message.Whole("episode");
            _t0 = message.Whole("t0_ns");
            SeedEpisode = message.Whole("seed_episode");
            _answers.Clear();
            _grants.Clear();
            _scene.Arrived = new string[0];
            _meshes.Reset(WasHereBefore);
            _said.Clear();
            _stepped = false;
            _newest = -1;
            Reset(message.Whole("seed"), _t0 / 1e9);
            _heart.Phase = "step";
            _state = State.Active;
            Send("RESET_DONE", With(new Map { { "episode", _episode } }));
        }

        /// <summary>Whether the broker may know meshes that an earlier process of this world
        /// announced.</summary>
        private bool WasHereBefore { get { return _epoch > 1 || _attempt > 1; } }

        // --- frames ----------------------------------------------------------------------------------------

        private void Answer()
        {
            var grant = _grants.Peek().Key;
            byte[] answer;
            long frame = grant.Whole("frame");
            if (!_answers.TryGetValue(frame, out answer))
            {
                if (frame < _newest)
                {
                    _grants.Dequeue();
                    Error("unexpected", "frame " + frame + " comes after frame " + _newest, "GRANT");
                    return;
                }
                answer = Answered(grant, _grants.Peek().Value);
                if (answer == null) return; // the world has not finished: the grant stays in front
                _answers[frame] = answer;
                _newest = frame;
            }
            _grants.Dequeue();
            _wire.Send(answer);
        }

        private byte[] Answered(Map grant, List<byte[]> parts)
        {
            Frame = grant.Whole("frame");
            var watch = System.Diagnostics.Stopwatch.StartNew();
            string phase = "decode", culprit = "";
            try
            {
                Decode(grant, parts, ref culprit);
                phase = "step";
                long now = grant.Whole("t_ns") - _t0;
                var commands = Products("action").SelectMany(Command.All).ToList();
                var objects = Step(now / 1e9, (_stepped ? _previous : now) / 1e9, commands);
                if (objects == null) return null;
                var given = objects.ToList();
                phase = "encode";
                foreach (var item in given) item.Mesh = Looked(item.Mesh);
                var product = _scene.Build(given);
                _previous = now;
                _stepped = true;
                var entry = new Map { { "topic", "scene" }, { "digest", product.Digest } };
                var measured = new Map { { "step", watch.ElapsedTicks * (
                    1000000000L / System.Diagnostics.Stopwatch.Frequency) } };
                var done = With(new Map { { "episode", _episode }, { "frame", Frame },
                    { "products", new List<object> { entry } }, { "measured", measured } });
                var change = _meshes.Change(Frame, given.Select(item => item.Mesh));
                if (change != null) done["geometry"] = change;
                return Framed("DONE", done, product.Header, product.Body);
            }
            catch (Exception problem) { return FaultOf(Frame, phase, problem, culprit); }
        }

        private void Decode(Map grant, List<byte[]> parts, ref string culprit)
        {
            _products.Clear();
            int at = 1;
            foreach (var input in grant.List("inputs").Cast<Map>()
                .Where(input => input.Text("status") != "absent"))
            {
                byte[] header = parts[at++], body = parts[at++];
                string topic = input.Text("topic"), source = input.Text("source"),
                    digest = input.Text("digest");
                try
                {
                    var decoded = Codec.DecodePayload(topic, header, body);
                    if (digest != "" && header.Length + body.Length <= DigestedBytes
                        && Product.DigestOf(header, body) != digest)
                        throw ProtocolException.Malformed("the bytes do not have the digest of their DONE");
                    List<Map> list;
                    if (!_products.TryGetValue(topic, out list)) _products[topic] = list = new List<Map>();
                    list.Add(decoded);
                }
                catch (ProtocolException problem)
                {
                    culprit = source;
                    throw new InvalidDataException(topic + " of " + source + " in frame " + Frame + ": "
                        + problem.Message, problem);
                }
            }
        }

        private void Fault(long frame, string phase, Exception problem, string culprit)
        {
            if (_wire != null) _wire.Send(FaultOf(frame, phase, problem, culprit));
        }

        private byte[] FaultOf(long frame, string phase, Exception problem, string culprit)
        {
            _faulted = true;
            Log(Name + ": " + phase + ": " + problem.Message);
            return Framed("FAULT", With(new Map
            {
                { "episode", _episode }, { "frame", frame }, { "phase", phase },
                { "message", problem.Message.Split('\n')[0] },
                { "detail", problem.ToString() }, { "culprit", culprit },
            }));
        }

        // --- state that outlives the process ---------------------------------------------------------------

        private byte[] Saved()
        {
            var head = MessagePack.Pack(new Map
            {
                { "arrived", _scene.Arrived.Cast<object>().ToList() }, { "previous", _previous },
                    { "stepped", _stepped }, { "newest", _newest },
            });
            var length = new byte[4];
            Bytes.PutWhole(length, 0, 4, head.Length);
            return StateMark.Concat(length).Concat(head).Concat(Save()).ToArray();
        }

        private void Restored(byte[] state)
        {
            int at = StateMark.Length + 4;
            if (state.Length < at || !state.Take(StateMark.Length).SequenceEqual(StateMark))
                throw new InvalidDataException("this is no state of a world of this library");
            long length = Bytes.Whole(state, StateMark.Length, 4);
            if (length > state.Length - at) throw new InvalidDataException("the state ends too early");
            var head = (Map)MessagePack.Unpack(state.Skip(at).Take((int)length).ToArray());
            _scene.Arrived = head.Texts("arrived");
            _previous = head.Whole("previous");
            _stepped = head.Flag("stepped");
            _newest = head.Whole("newest");
            _meshes.Reset(WasHereBefore, _newest + 1);
            Restore(state.Skip(at + (int)length).ToArray());
        }
    }

    /// <summary>SIGTERM, where the runtime lets a program see it: .NET by itself, Mono with
    /// Mono.Posix.</summary>
    internal sealed class Termination
    {
        private volatile bool _set;
        private readonly ManualResetEvent _left = new ManualResetEvent(false);
        private WaitHandle _signal;
        private PropertyInfo _isSet;

        public bool IsSet { get { return _set || _signal != null && (bool)_isSet.GetValue(_signal, null); } }

        public static Termination Watch()
        {
            var found = new Termination();
            try
            {
                var posix = Assembly.Load(
                    "Mono.Posix, Version=4.0.0.0, Culture=neutral, PublicKeyToken=0738eb9f132ed756");
                var type = posix.GetType("Mono.Unix.UnixSignal");
                found._isSet = type.GetProperty("IsSet");
                found._signal = (WaitHandle)Activator.CreateInstance(type,
                    Enum.ToObject(posix.GetType("Mono.Unix.Native.Signum"), 15));
            }
            catch (Exception problem) when (problem is IOException || problem is BadImageFormatException)
            {
                // .NET raises ProcessExit at SIGTERM, and ends when its handlers return: BYE goes out
                // meanwhile.
                AppDomain.CurrentDomain.ProcessExit += (sender, arguments) =>
                    { found._set = true; found._left.WaitOne(1000); };
            }
            return found;
        }
    }
}

// What the tests ask of Caviar.cs: Check.exe KIND FILE
//
// Each line of the file is a case, its fields divided by tabs, and each line of the output is its answer.
using System;
using System.Collections.Generic;
using System.Globalization;
using System.IO;
using System.Linq;
using System.Reflection;
using Caviar;

internal static class Check
{
    private static void Main(string[] arguments)
    {
        var answers = new Dictionary<string, Func<string[], string>>
        {
            { "vectors", Vector }, { "arrays", Elements }, { "axes", Converted }, { "mounts", Mounted },
            { "match", Match }, { "mesh", Mesh }, { "engine_mesh", EngineMesh },
            { "offered", Offered }, { "spawned", Spawned }, { "spawn", Spawn },
            { "users", Users }, { "paths", Paths }, { "commands", Commands },
        };
        foreach (var line in File.ReadAllLines(arguments[1]))
            Console.WriteLine(answers[arguments[0]](line.Split('\t')));
    }

    // kind, topic, header, body, further parts (hex or #LENGTH): "ok HEADER BODY" of what is written again,
    // or the code.
    private static string Vector(string[] fields)
    {
        byte[] header = Hex(fields[2]), body = Hex(fields[3]);
        try
        {
            if (fields[0] == "arrays") { Codec.DecodeArrays(header, body); return "ok"; }
            if (fields[0] == "payload")
            {
                var product = Codec.EncodePayload(fields[1], Codec.DecodePayload(fields[1], header, body));
                return "ok\t" + Hex(product.Header) + "\t" + Hex(product.Body) + "\t" + product.Digest;
            }
            var message = Codec.DecodeMessage(header);
            var parts = new List<byte[]> { header };
            if (fields[4] != "")
                parts.AddRange(fields[4].Split(',').Select(part => part.StartsWith("#")
                    ? new byte[int.Parse(part.Substring(1))] : Hex(part)));
            Codec.CheckParts(message, parts);
            if (!Codec.Split(Codec.Join(parts.ToArray())).Select(Hex).SequenceEqual(parts.Select(Hex)))
                return "other parts in a frame";
            return "ok\t" + Hex(Codec.EncodeMessage(message.Text("type"), message)) + "\t"
                + (parts.Sum(part => part.Length) < 4096 ? Hex(Codec.Join(parts.ToArray())) : "");
        }
        catch (ProtocolException problem) { return problem.Code; }
    }

    private static string Elements(string[] fields)
    {
        return string.Join("\t", Codec.DecodeArrays(Hex(fields[0]), Hex(fields[1]))
            .Select(array => Text(array.ToDoubles()) + ";"
                + (array.Dtype.Contains("i") || array.Dtype.Contains("u") ? string.Join(" ", array.ToLongs())
                : "")));
    }

    private static readonly Dictionary<string, Axes> Engines = new Dictionary<string, Axes>
    {
        { "unreal", Axes.Unreal }, { "unity", Axes.Unity }, { "godot", Axes.Godot }, { "ned", Axes.Ned },
    };

    // engine, vertices, triangles: the same in ENU.
    private static string EngineMesh(string[] fields)
    {
        var mesh = Engines[fields[0]].MeshToEnu(Rows(fields[1]), Triangles(fields[2]));
        return Text(mesh.Vertices.SelectMany(row => row).ToArray()) + "\t"
            + Text(mesh.Triangles.SelectMany(row => row).Select(corner => (double)corner).ToArray());
    }

    // MAX_FACES, the vertices of a mesh, offered before and, where MAX_FACES is given, while a run goes on: what
    // OfferMesh returns.
    private static string Offered(string[] fields)
    {
        var world = new Still { Log = line => { } };
        Func<string, FieldInfo> own = name => typeof(World).GetField(name,
            BindingFlags.Instance | BindingFlags.NonPublic);
        var meshes = (RunTimeMeshes)own("_meshes").GetValue(world);
        meshes.MaxFaces = fields[0] == "" ? 0 : long.Parse(fields[0]);
        own("_state").SetValue(world, Enum.Parse(own("_state").FieldType, fields[0] == "" ? "Preparing" : "Ready"));
        var found = world.OfferMesh("car", Rows(fields[1]), new[] { new[] { 0, 1, 2 } });
        return string.Concat(found.Mesh.Take(11)) + "\t" + Text(found.Dimensions) + "\t" + Text(found.Centre);
    }

    // engine, position, orientation, velocity, angular velocity in ENU: the same in the engine's axes, and
    // back.
    private static string Converted(string[] fields)
    {
        var axes = Engines[fields[0]];
        double[][] numbers = fields.Skip(1).Select(Numbers).ToArray();
        var pose = axes.PoseFromEnu(new Pose(numbers[0], numbers[1]));
        var motion = axes.MotionFromEnu(new Motion(numbers[2], numbers[3]));
        var poseBack = axes.PoseToEnu(pose);
        var motionBack = axes.MotionToEnu(motion);
        return string.Join("\t", new[]
        {
            pose.Position, pose.Orientation, motion.Velocity, motion.AngularVelocity,
            poseBack.Position, poseBack.Orientation, motionBack.Velocity, motionBack.AngularVelocity,
        }.Select(Text));
    }

    private static SceneBuilder _builder;

    // welcome HEADER, then a line a frame: name|class|position|orientation|velocity|dimensions, divided by
    // tabs.
    private static string Mounted(string[] fields)
    {
        if (fields[0] == "welcome")
        {
            _builder = new SceneBuilder(Codec.DecodeMessage(Hex(fields[1])).Child("scenario").List("devices")
                .Cast<Map>());
            return "";
        }
        try
        {
            var product = _builder.Build(fields.Select(field => field.Split('|'))
                .Select(words => new WorldObject(words[0], words[1], Numbers(words[2]), Numbers(words[5]))
            {
                Orientation = Numbers(words[3]), Velocity = Numbers(words[4]),
            }));
            return Hex(product.Header) + "\t" + Hex(product.Body);
        }
        catch (ArgumentException problem) { return problem.Message; }
    }

    // header, body: a field for each user, path or command.
    private static string Users(string[] fields)
    {
        return string.Join("\t", LinkUser.All(Codec.DecodePayload("link", Hex(fields[0]), Hex(fields[1])))
            .Select(user => user.Tx + " " + user.Rx + " " + user.Carrier + " "
                + Text(new[] { user.AbsY, user.Snr, user.TxBeam, user.RxBeam })));
    }

    private static string Paths(string[] fields)
    {
        return string.Join("\t", ChannelPath.All(Codec.DecodePayload("channel", Hex(fields[0]),
            Hex(fields[1])))
            .Select(path => path.Tx + " " + path.Rx + " "
                + Text(new[] { path.Tau }.Concat(path.Aod).Concat(path.Real).Concat(path.Imaginary)
                .Concat(path.Doppler)
                .Concat(path.Interactions.Select(kind => (double)kind))
                    .Concat(path.Points.SelectMany(point => point)).ToArray())));
    }

    private static string Commands(string[] fields)
    {
        return string.Join("\t", Command.All(Codec.DecodePayload("action", Hex(fields[0]), Hex(fields[1])))
            .Select(command => command.Type + " " + (command.Object == "" ? command.Tx : command.Object)
                + " " + Text(new[] { command.TxBeam, command.Speed }.Concat(command.Position
                ?? command.Velocity ?? new double[0]).ToArray())));
    }

    private static string Match(string[] fields)
    {
        return SceneBuilder.Matches(fields[0], fields[1]).ToString();
    }

    private sealed class Still : World
    {
        protected override IEnumerable<WorldObject> Step(double t, double previous, IList<Command> commands)
        {
            return null;
        }
    }

    // A wrong mesh or material: the message of the error.
    private static string Mesh(string[] fields)
    {
        try
        {
            if (fields[0] == "material")
                new Material(fields[1], fields[2], double.Parse(fields[3], CultureInfo.InvariantCulture));
            else new Still().OfferMesh(fields[1], new[] { new double[3], new double[3], new double[3] },
                new[] { Numbers(fields[2]).Select(n => (int)n).ToArray() });
            return "ok";
        }
        catch (ArgumentException problem) { return problem.Message; }
    }

    // Steps `limit N`, `reset AGAIN FRAME`, `add HEX`, `refuse MESH`, `frame NUMBER MESH,MESH`, where a MESH is the
    // number of one that was added: the names of `add`, what DONE says of `frame`.
    private static string Spawned(string[] fields)
    {
        var meshes = new RunTimeMeshes();
        var names = new List<string>();
        var answers = new List<string>();
        foreach (var words in fields.Select(field => field.Split(' ')))
        {
            if (words[0] == "limit") meshes.MaxFaces = long.Parse(words[1]);
            if (words[0] == "reset") meshes.Reset(words[1] == "1", long.Parse(words[2]));
            if (words[0] == "add") { names.Add(meshes.Add(Hex(words[1]))); answers.Add(names.Last()); }
            if (words[0] == "refuse") meshes.Refuse(names[int.Parse(words[1])].Substring(8, 64));
            if (words[0] != "frame") continue;
            var used = words[2].Split(',').Where(word => word != "").Select(word => names[int.Parse(word)]);
            var change = meshes.Change(long.Parse(words[1]), used);
            answers.Add(change == null ? "-" : change.Whole("frame") + ":"
                + string.Join(",", change.List("assets").Cast<Map>().Select(asset => asset.Text("name"))));
        }
        return string.Join("\t", answers);
    }

    // A mesh that comes while a run goes on, MAX_FACES, vertices, triangles: why it would be refused.
    private static string Spawn(string[] fields)
    {
        try
        {
            RunTimeMeshes.Check(fields[0], Rows(fields[2]), Triangles(fields[3]), long.Parse(fields[1]));
            return "ok";
        }
        catch (ArgumentException problem) { return problem.Message; }
    }

    private static List<double[]> Rows(string text)
    {
        var numbers = text == "" ? new double[0] : Numbers(text);
        return Enumerable.Range(0, numbers.Length / 3).Select(i => numbers.Skip(3 * i).Take(3).ToArray()).ToList();
    }

    private static List<int[]> Triangles(string text)
    {
        return Rows(text).Select(row => row.Select(n => (int)n).ToArray()).ToList();
    }

    private static string Text(double[] numbers)
    {
        return string.Join(" ", numbers.Select(number => number.ToString("R", CultureInfo.InvariantCulture)));
    }
    private static double[] Numbers(string text) { return text.Split(' ').Select(Number).ToArray(); }
    private static double Number(string word)
    {
        if (word[0] == 'x') return BitConverter.Int64BitsToDouble(Convert.ToInt64(word.Substring(1), 16));
        return double.Parse(word, CultureInfo.InvariantCulture);
    }

    private static string Hex(byte[] bytes)
    {
        return string.Concat(bytes.Select(value => value.ToString("x2")));
    }
    private static byte[] Hex(string text)
    {
        return Enumerable.Range(0, text.Length / 2).Select(i =>
            Convert.ToByte(text.Substring(2 * i, 2), 16)).ToArray();
    }
}
